"""The sparse grid by recursion over sets of points (section 3.3)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from octoseg_ti.types import StopReason

KEY_BITS = 21


@dataclass
class Cell:
    """A cell of the tree, with its points."""

    level: int
    place: tuple[int, int, int]
    members: np.ndarray
    normal: np.ndarray
    point: np.ndarray
    sigma: float
    residual: float
    stop: StopReason | None = None
    daughters: list[Cell] = field(default_factory=list)

    @property
    def key(self) -> tuple[int, int, int, int]:
        return (self.level, *self.place)

    @property
    def leaf(self) -> bool:
        return not self.daughters


def statistics(
    points: np.ndarray, normals: np.ndarray, signed: bool
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return unit mean normal, mean point, deviation (Eq. 4) and rms distance from the mean plane.

    Rows without a normal take no part in the mean and the deviation of the normals.
    """
    mean_point = points.mean(axis=0)
    present = normals[np.any(normals != 0, axis=1)]
    if len(present) == 0:
        direction, sigma = np.zeros(3), 1.0
        if not signed:
            direction = np.full(3, np.nan)  # any axis
    elif signed:
        mean = present.mean(axis=0)
        sigma = math.sqrt(np.mean(np.sum((present - mean) ** 2, axis=1)))  # Eq. 4 as printed
        size = np.linalg.norm(mean)
        direction = mean / size if size > 0 else mean
    else:
        value, vector = np.linalg.eigh(present.T @ present / len(present))
        direction, sigma = vector[:, 2], math.sqrt(max(0.0, 1.0 - value[2]))
    offsets = (points - mean_point) @ direction
    return direction, mean_point, sigma, math.sqrt(np.mean(offsets**2))


def cells_along(extent: float, size: float) -> int:
    """Return the smallest number of cells, at least one, that cover a length but for rounding."""
    cells = 1
    while cells * size < extent * (1 - 1e-12):
        cells += 1
    return cells


def layout(
    extent: np.ndarray, divisions: int | None, min_cell: float
) -> tuple[float, tuple[int, ...], int]:
    """Return size and number of the initial cells, and the levels below them."""
    if divisions is not None:
        size = float(extent[extent > 1e-9 * extent.max()].min()) / divisions
    else:
        size = 16.0 * min_cell
        while math.prod(cells_along(e, size) for e in extent) > 2**21:
            size *= 2.0
    shape = tuple(cells_along(e, size) for e in extent)
    bits = max(1, (max(shape) - 1).bit_length())
    depth = KEY_BITS - bits
    if min_cell > 0:
        depth = 0
        while size / 2 ** (depth + 1) >= min_cell * (1 - 1e-9):
            depth += 1
    return size, shape, depth


@dataclass
class Tree:
    """All cells by (level, x, y, z)."""

    size: float
    shape: tuple[int, ...]
    depth: int
    corner: np.ndarray
    cells: dict[tuple[int, int, int, int], Cell]
    passes: int
    closest: float
    """How near a cell came to the limits without saying so: comparisons below 1e-6 are chance."""

    @property
    def leaves(self) -> list[Cell]:
        return [c for c in self.cells.values() if c.leaf]


def build_tree(
    points: np.ndarray,
    normals: np.ndarray,
    *,
    tolerance: float,
    edge_tolerance: float | None = None,
    divisions: int | None = None,
    min_cell: float = 0.0,
    min_points: int = 2,
    flatness: float = math.inf,
    noise: float = 0.0,
    signed: bool = True,
) -> Tree:
    """Split every cell whose normals deviate more than the tolerance."""
    corner = points.min(axis=0)
    size, shape, depth = layout(points.max(axis=0) - corner, divisions, min_cell)
    finest = size / 2.0**depth
    roughness = max(tolerance, edge_tolerance or 0.0)
    most = np.array(shape) * 2**depth - 1
    box = np.clip(np.floor((points - corner) / finest), 0, most).astype(np.int64)
    cells: dict[tuple[int, int, int, int], Cell] = {}
    closest = math.inf

    def add(level: int, place: tuple[int, ...], members: np.ndarray) -> Cell:
        nonlocal closest
        normal, point, sigma, residual = statistics(points[members], normals[members], signed)
        cell = Cell(
            level=level, place=(place[0], place[1], place[2]), members=members, normal=normal,
            point=point, sigma=sigma, residual=residual,
        )  # fmt: skip
        cells[cell.key] = cell
        edge = size / 2.0**level
        most_residual = flatness * tolerance * edge + 3 * noise
        closest = min(closest, abs(sigma - tolerance), abs(sigma - roughness))
        if math.isfinite(flatness):
            closest = min(closest, abs(residual - most_residual) / size)
        if sigma <= tolerance and not residual > most_residual:
            cell.stop = StopReason.HOMOGENEOUS
            return cell
        if len(members) < min_points:
            cell.stop = StopReason.FEW_POINTS
        elif edge / 2 < min_cell * (1 - 1e-9):
            cell.stop = StopReason.MIN_SIZE
        elif level == depth:
            cell.stop = StopReason.MAX_LEVEL
        if cell.stop is not None:
            # A cell that cannot be split may be somewhat rougher and still pass.
            if sigma <= roughness and not residual > most_residual:
                cell.stop = StopReason.HOMOGENEOUS
        else:
            below = depth - level - 1
            for daughter in sorted({tuple(b) for b in (box[members] >> below).tolist()}):
                inside = np.all(box[members] >> below == daughter, axis=1)
                cell.daughters.append(add(level + 1, daughter, members[inside]))
        return cell

    for place in sorted({tuple(b) for b in (box >> depth).tolist()}):
        add(0, place, np.flatnonzero(np.all(box >> depth == place, axis=1)))
    split = {c.level for c in cells.values() if not c.leaf}
    return Tree(
        size=size, shape=shape, depth=depth, corner=corner, cells=cells, passes=1 + len(split),
        closest=closest,
    )  # fmt: skip
