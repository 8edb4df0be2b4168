"""The renderer: known pixels, what hides what, and shapes that must agree."""

import numpy as np
import pytest

from octoseg_ti.view.render import Camera, Canvas, render

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
TOP = dict(direction=(0, 0, -1), up=(0, 1, 0))


def camera(width=9, height=7, scale=1.0):
    """Return a camera that looks down, x to the right, y up, the origin in the middle."""
    return Camera(
        direction=np.array([0.0, 0, -1]), right=np.array([1.0, 0, 0]), down=np.array([0.0, -1, 0]),
        center=np.zeros(3), scale=scale, width=width, height=height,
    )  # fmt: skip


def colored(picture, color):
    """Return (row, column) of the pixels of a colour."""
    return np.argwhere((picture == color).all(axis=2)).tolist()


def test_one_point_lands_on_its_pixel():
    picture = render(np.array([[2.0, 1.0, 5.0]]), RED, camera=camera(), point_px=1)
    assert picture.shape == (7, 9, 3) and picture.dtype == np.uint8
    assert colored(picture, RED) == [[2, 6]]  # 9 / 2 + 2, 7 / 2 - 1
    assert (picture == 255).all(axis=2).sum() == 9 * 7 - 1


def test_a_point_of_three_pixels_is_a_square_that_ends_at_the_border():
    picture = render(np.array([[0.0, 0, 0]]), RED, camera=camera(), point_px=3)
    assert colored(picture, RED) == [[r, c] for r in (2, 3, 4) for c in (3, 4, 5)]
    corner = render(np.array([[-4.0, 3.0, 0]]), RED, camera=camera(), point_px=3)
    assert colored(corner, RED) == [[0, 0], [0, 1], [1, 0], [1, 1]]


@pytest.mark.parametrize("order", [[0, 1, 2], [2, 1, 0], [1, 2, 0]])
@pytest.mark.parametrize("size", [1, 2, 3])
def test_nearer_covers_farther(order, size):
    points = np.array([[0.0, 0, 1], [0, 0, 2], [0, 0, -1]])[order]
    colors = np.array([RED, GREEN, BLUE], np.uint8)[order]
    picture = render(points, colors, camera=camera(), point_px=size, eye_dome=0)
    assert len(colored(picture, GREEN)) == size * size
    assert not colored(picture, RED) and not colored(picture, BLUE)


def test_squares_cover_by_depth_where_they_overlap():
    points = np.array([[0.0, 0, 0], [2.0, 0, 1]])
    picture = render(points, np.array([RED, GREEN], np.uint8), camera=camera(), point_px=3,
                     eye_dome=0)  # fmt: skip
    assert picture[3, 5].tolist() == list(GREEN)  # both squares reach this pixel
    assert picture[3, 3].tolist() == list(RED)


def test_directions_of_the_picture():
    # Looking along -y with z up, x runs to the left.
    points = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 0, 2.0], [0, 0, 0]])
    colors = np.array([RED, GREEN, BLUE, (9, 9, 9)], np.uint8)
    picture = render(points, colors, width=41, height=41, direction=(0, -1, 0), point_px=1)
    (red,), (green,), (blue,) = (colored(picture, c) for c in (RED, GREEN, BLUE))
    assert red[1] < blue[1] < green[1]
    assert blue[0] < red[0] == green[0]


def test_everything_fits():
    rng = np.random.default_rng(2)
    points = rng.normal(size=(200, 3)) * [30, 5, 1] + 1e6
    cam = Camera.fit(points, direction=(-0.4, 0.75, -0.6), width=200, height=100, margin=0.1)
    at = cam.project(points)
    assert at[:, 0].min() >= 20 - 0.1 and at[:, 0].max() <= 180 + 0.1
    assert at[:, 1].min() >= 10 - 0.1 and at[:, 1].max() <= 90 + 0.1
    touches = [at[:, 0].min() - 20, 180 - at[:, 0].max(), at[:, 1].min() - 10]
    assert min(np.abs(touches)) < 0.1


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.ones((1, 3)),
        np.ones((5, 3)),
        np.full((3, 3), np.nan),
        np.array([[0.0, 0, 0], [np.inf, 0, 0], [0, np.nan, 1]]),
    ],
)
def test_strange_input_gives_a_picture(points):
    picture = render(points, RED, width=20, height=10, **TOP)
    finite = np.isfinite(points).all(axis=1).any()
    assert picture.shape == (10, 20, 3)
    assert bool(len(colored(picture, RED))) == finite


def test_shading_darkens_what_lies_behind_and_nothing_else():
    x, y = (a.ravel().astype(float) for a in np.meshgrid(np.arange(40), np.arange(40)))
    points = np.stack([x, y, np.where(x > 20, 30.0, 0.0)], axis=1)
    picture = render(points, (200, 200, 200), width=60, height=60, point_px=2, **TOP)
    cam = Camera.fit(points, width=60, height=60, **TOP)
    column = int(cam.project(points[[20]])[0, 0])
    row = 30
    assert picture[row, column, 0] < 190
    assert picture[row, 8, 0] == 200
    assert picture[row, 52, 0] == 200
    flat = render(points, (200, 200, 200), width=60, height=60, eye_dome=0, **TOP)
    assert set(np.unique(flat)) == {200, 255}


def test_a_line_has_no_gaps():
    canvas = Canvas(camera(21, 21))
    canvas.lines(np.array([[-8.0, -8, 0]]), np.array([[8.0, 4, 3]]), RED)
    pixels = np.array(colored(canvas.image(eye_dome=0), RED))
    assert {int(c) for c in pixels[:, 1]} == set(range(2, 19))
    steps = np.abs(np.diff(pixels[np.argsort(pixels[:, 1])], axis=0)).max(axis=0)
    assert steps.tolist() == [1, 1]
    canvas.lines(np.zeros((0, 3)), np.zeros((0, 3)), RED)


def test_a_box_seen_from_above_is_a_framed_square():
    canvas = Canvas(camera(41, 41))
    canvas.boxes(np.array([[-10.0, -10, 0]]), 20.0, (200, 100, 50))
    picture = canvas.image(eye_dome=0)
    assert picture[20, 20].tolist() == [200, 100, 50]
    covered = np.argwhere((picture < 255).any(axis=2))
    assert np.ptp(covered, axis=0).tolist() == [19, 19]
    assert picture[20, covered[:, 1].min(), 0] < 100  # the frame


def test_a_box_hides_what_is_inside_and_behind():
    cam = Camera.fit(np.array([[0.0, 0, 0], [10, 10, 10]]), direction=(-0.5, 0.7, -0.6),
                     width=80, height=80)  # fmt: skip
    canvas = Canvas(cam)
    canvas.points(np.array([[5.0, 5, 5], [5, 9.9, 0.1]]), RED, size=3)
    canvas.boxes(np.zeros((1, 3)), 10.0, (100, 100, 100))
    assert not colored(canvas.image(eye_dome=0), RED)
    canvas.points(np.array([[5.0, 5, 10.5]]), RED, size=3)
    assert len(colored(canvas.image(eye_dome=0), RED)) == 9


def test_a_frame_has_twelve_edges():
    canvas = Canvas(camera(41, 41))
    canvas.frames(np.array([[-10.0, -10, 0]]), 20.0, RED)
    picture = canvas.image(eye_dome=0)
    assert picture[20, 20].tolist() == [255, 255, 255]
    assert len(colored(picture, RED)) == 4 * 20  # from above: the outline


def test_bad_arguments():
    with pytest.raises(ValueError, match="shape"):
        render(np.zeros((3, 2)), RED)
    with pytest.raises(ValueError, match="one colour each"):
        render(np.zeros((3, 3)), np.zeros((2, 3), np.uint8))
    with pytest.raises(ValueError, match="parallel"):
        render(np.zeros((3, 3)), RED, direction=(0, 0, 2))
    with pytest.raises(ValueError, match="pixel"):
        render(np.zeros((3, 3)), RED, point_px=0)
    with pytest.raises(ValueError, match="pixels"):
        render(np.zeros((3, 3)), RED, width=0)
