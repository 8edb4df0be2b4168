"""The scans that count: the simulator's three parts, and real ones where they are at hand."""

import gzip
import shutil
from pathlib import Path

import numpy as np
import pytest

from octoseg_ti import SurfaceKind, evaluate, read, segment


@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize(
    ("part", "patches"), [("two-planes", 2), ("test-block", 11), ("phone", 32)]
)
def test_simulated_parts_are_segmented_without_a_fault(
    part: str, patches: int, noise: float
) -> None:
    """No parameter given: every patch correct at an overlap of 0.8, and an ARI of 0.97."""
    from scanner_sim import StripeScanner, blocks, simulate

    scans, truth = simulate(blocks.by_name(part), StripeScanner(range_noise=noise), seed=0)
    scores = evaluate(segment(scans), truth).regions
    found = (scores.correct, scores.over, scores.under, scores.missed, scores.noise)
    assert found == (patches, 0, 0, 0, 0)
    assert scores.ari >= 0.97


def stripes_of(folder: Path, name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    with np.load(folder / name) as file:
        return file["points"], file["stripe"], file["labels"].astype(np.int32)


def test_three_planes_of_a_height_map(shared: Path) -> None:
    points, stripe, labels = stripes_of(shared, "proper_test.npz")
    scores = evaluate(segment(points, stripe=stripe), labels).regions
    assert (scores.patches, scores.correct) == (3, 3)


def test_facets_of_a_steel_column(shared: Path) -> None:
    points, stripe, labels = stripes_of(shared, "pyss_lower.npz")
    labels[labels > 15] = -1  # 16-31 are the bends between the facets
    scores = evaluate(segment(points, stripe=stripe), labels).regions
    assert (scores.patches, scores.correct) == (16, 16)


def test_faces_of_a_polyhedral_scene_are_found(shared: Path) -> None:
    """Of 13 labels three have less than 21 points, one of them scattered; one face is grazed."""
    points, stripe, labels = stripes_of(shared, "synpeb_100.npz")
    scores = evaluate(segment(points, stripe=stripe), labels).regions
    assert scores.patches == 13 and scores.correct >= 9
    assert scores.ari > 0.99


@pytest.mark.parametrize("name", ["bun000", "bun045"])
def test_a_free_form_gets_no_large_plane(shared: Path, tmp_path: Path, name: str) -> None:
    packed = shared / "stanford_bunny" / f"{name}.ply.gz"
    if not packed.is_file():
        pytest.skip(f"no {packed}")
    path = tmp_path / f"{name}.ply"
    with gzip.open(packed, "rb") as source, path.open("wb") as target:
        shutil.copyfileobj(source, target)
    result = segment(read(path))
    assert np.mean(result.labels >= 0) > 0.0
    planes = np.flatnonzero(result.kind == SurfaceKind.PLANE)
    largest = max((np.mean(result.labels == k) for k in planes), default=0.0)
    assert largest <= 0.02


def test_every_cad_cloud_runs(shared: Path) -> None:
    files = sorted((shared / "fit4cad_train").glob("PC*.npz"))
    assert len(files) == 24
    for path in files:
        with np.load(path) as file:
            points = file["points"]
        result = segment(points)
        assert len(result) == len(points) and np.mean(result.labels >= 0) > 0.0, path.name
        assert result.patch_count > 0, path.name


def test_a_scene_with_sensor_noise(shared: Path) -> None:
    points, stripe, _ = stripes_of(shared, "synpeb_100.npz")
    result = segment(points, stripe=stripe)
    assert len(result) == len(points) and result.patch_count > 0
