"""Parameters (u, v) of the surfaces of a part, and where in them its faces end."""

import math
from typing import NamedTuple

import numpy as np

from octoseg_ti.device import runtime
from octoseg_ti.device.runtime import F64Rows, I32Array, I32Rows, ti
from octoseg_ti.types import SurfaceKind
from scanner_sim.crossings import vector
from scanner_sim.part import FlatPart
from scanner_sim.quadric import frames
from scanner_sim.raycast import side_at, upload_program

_PLANE, _CYLINDER = int(SurfaceKind.PLANE), int(SurfaceKind.CYLINDER)
_CONE, _SPHERE = int(SurfaceKind.CONE), int(SurfaceKind.SPHERE)
_HALVINGS = 18  # from a cell's size to some nanometres
_LEAST_HEIGHT = 0.05  # cones are scaled by their widest place, this far from the apex or more [mm]


class Chart(NamedTuple):
    """Parameters (u, v) of all surfaces, scaled so that a unit is about a millimetre.

    u is a coordinate of a plane, else the angle about the axis; v is the other coordinate, the
    height (cylinder, cone), the latitude (sphere), or the angle about the tube (torus).
    """

    part: FlatPart
    axes: np.ndarray
    """Direction from which angles count, or of u (3); direction of a quarter turn, or of v (3);
    millimetres per unit of u and v, at the widest place (2); shape (S, 8)."""

    @property
    def scale(self) -> np.ndarray:
        """Millimetres per unit of u and v, shape (S, 2)."""
        return self.axes[:, 6:]

    def points(self, index: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Return positions [mm], shape (N, 3).

        Args:
            index: Surface of every place, shape (N,), i32.
            place: Scaled parameters, shape (N, 2).
        """
        count = len(index)
        points = runtime.empty((count, 3), np.float64)
        if count:
            surfaces = self.part.surfaces
            _place_points(
                runtime.upload(surfaces.kind), runtime.upload(surfaces.data),
                runtime.upload(self.axes), *_places(index, place), points,
            )  # fmt: skip
            runtime.sync()
        return runtime.download(points)[:count]

    def sides(self, index: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Return on which side of its surface the part lies at every place, shape (N,), i32.

        1 = inside, -1 = outside, 0 = on neither side or on both: the surface does not bound it.
        """
        count = len(index)
        sides = runtime.empty(count, np.int32)
        if count:
            _find_sides(*self._program(), *_places(index, place), sides)
            runtime.sync()
        return runtime.download(sides)[:count]

    def ends(self, index: np.ndarray, inner: np.ndarray, outer: np.ndarray) -> np.ndarray:
        """Return where between two places, with different sides, the side changes, shape (N, 2)."""
        count = len(index)
        found = runtime.empty((count, 2), np.float64)
        if count:
            _halve(*self._program(), *_places(index, inner), _places(index, outer)[1], found)
            runtime.sync()
        return runtime.download(found)[:count]

    def _program(self) -> tuple[object, ...]:
        return (*upload_program(self.part), runtime.upload(self.axes))


def make_chart(part: FlatPart) -> Chart:
    """Return the parameters of all surfaces of a part."""
    kind, a, b = part.surfaces.kind, part.surfaces.data[:, 6], part.surfaces.data[:, 7]
    scale = np.ones((len(kind), 2))
    scale[kind == SurfaceKind.CYLINDER, 0] = a[kind == SurfaceKind.CYLINDER]
    ball = kind == SurfaceKind.SPHERE
    scale[ball] = a[ball, None]
    ring = kind == SurfaceKind.TORUS
    scale[ring, 0], scale[ring, 1] = (a + b)[ring], b[ring]
    for s in np.flatnonzero(kind == SurfaceKind.CONE):
        apex, axis = part.surfaces.data[s, :3], part.surfaces.data[s, 3:6]
        highest = ((corners(part.surface_boxes[s]) - apex) @ axis).max()
        scale[s, 0] = max(highest, _LEAST_HEIGHT) * math.tan(a[s])
    return Chart(part, np.concatenate([*frames(part.surfaces), scale], axis=1))


def corners(limits: np.ndarray) -> np.ndarray:
    """Return the corners of a box, shape (8, 3)."""
    return np.array([[limits[i, 0], limits[j, 1], limits[k, 2]]
                     for i in (0, 1) for j in (0, 1) for k in (0, 1)])  # fmt: skip


def _places(index: np.ndarray, place: np.ndarray) -> tuple[object, object]:
    return (
        runtime.upload(np.ascontiguousarray(index, np.int32)),
        runtime.upload(np.ascontiguousarray(place, np.float64)),
    )


@ti.func
def _point(kinds: ti.template(), data: ti.template(), axes: ti.template(), s, scaled):
    """Return the position of scaled parameters on surface s."""
    u, v = scaled[0] / axes[s, 6], scaled[1] / axes[s, 7]
    a, b = data[s, 6], data[s, 7]
    kind = kinds[s]
    x, y, z = u, v, 0.0
    if kind != _PLANE:
        radius, z = a, v
        if kind == _CONE:
            radius = v * ti.tan(a)
        elif kind == _SPHERE:
            radius, z = a * ti.cos(v), a * ti.sin(v)
        elif kind != _CYLINDER:
            radius, z = a + b * ti.cos(v), b * ti.sin(v)
        x, y = radius * ti.cos(u), radius * ti.sin(u)
    return (
        vector(data, s, 0) + x * vector(axes, s, 0) + y * vector(axes, s, 3)
        + z * vector(data, s, 3)
    )  # fmt: skip


@ti.kernel
def _place_points(
    # In:
    kinds_in: I32Array,
    data_in: F64Rows,
    axes_in: F64Rows,
    index_in: I32Array,
    places_in: F64Rows,
    # Out:
    points_out: F64Rows,
):
    """Turn parameters into positions."""
    for i in range(index_in.shape[0]):
        scaled = ti.Vector([places_in[i, 0], places_in[i, 1]])
        p = _point(kinds_in, data_in, axes_in, index_in[i], scaled)
        for k in ti.static(range(3)):
            points_out[i, k] = p[k]


@ti.kernel
def _find_sides(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    axes_in: F64Rows,
    index_in: I32Array,
    places_in: F64Rows,
    # Out:
    sides_out: I32Array,
):
    """Ask for every place whether its surface decides that it is solid."""
    for i in range(index_in.shape[0]):
        s = index_in[i]
        p = _point(kinds_in, data_in, axes_in, s, ti.Vector([places_in[i, 0], places_in[i, 1]]))
        sides_out[i] = side_at(code_in, first_in, grid_in, kinds_in, data_in, p, s)


@ti.kernel
def _halve(
    # In:
    code_in: I32Rows,
    first_in: I32Array,
    grid_in: F64Rows,
    kinds_in: I32Array,
    data_in: F64Rows,
    axes_in: F64Rows,
    index_in: I32Array,
    inner_in: F64Rows,
    outer_in: F64Rows,
    # Out:
    places_out: F64Rows,
):
    """Halve the way between two places until its two ends are as good as one."""
    for i in range(index_in.shape[0]):
        s = index_in[i]
        low = ti.Vector([inner_in[i, 0], inner_in[i, 1]])
        high = ti.Vector([outer_in[i, 0], outer_in[i, 1]])
        p = _point(kinds_in, data_in, axes_in, s, low)
        before = side_at(code_in, first_in, grid_in, kinds_in, data_in, p, s)
        for _ in range(_HALVINGS):
            middle = 0.5 * (low + high)
            p = _point(kinds_in, data_in, axes_in, s, middle)
            if side_at(code_in, first_in, grid_in, kinds_in, data_in, p, s) == before:
                low = middle
            else:
                high = middle
        for k in ti.static(range(2)):
            places_out[i, k] = 0.5 * (low[k] + high[k])
