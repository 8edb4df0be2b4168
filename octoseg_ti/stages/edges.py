"""Stage 5: which cells are edges (section 3.4), and of which class."""

import math

import numpy as np

from octoseg_ti.types import EdgeClass, StopReason


def edges_by_reason(stop: np.ndarray) -> np.ndarray:
    """Return the edge class of leaves by why they stopped: rough cells that could not split.

    Args:
        stop: `StopReason` of every leaf, shape (C,).

    Returns:
        `EdgeClass` of every leaf, shape (C,), u8.
    """
    rough = stop != int(StopReason.HOMOGENEOUS)
    return np.where(rough, int(EdgeClass.SHARP), int(EdgeClass.NONE)).astype(np.uint8)


def edges_by_level(level: np.ndarray, smallest_levels: int, fillet_levels: int = 0) -> np.ndarray:
    """Return the edge class of leaves by their size: the smallest of the sizes that occur (S1, S3).

    Args:
        level: Level of every leaf, shape (C,).
        smallest_levels: How many of the smallest sizes are edges.
        fillet_levels: How many of these sizes are fillets, counted from the largest.

    Returns:
        `EdgeClass` of every leaf, shape (C,), u8.

    Raises:
        ValueError: More fillet levels than edge levels, or a negative number.
    """
    if not 0 <= fillet_levels <= smallest_levels:
        raise ValueError(
            f"fillet_levels must be 0..{smallest_levels} (smallest_levels), not {fillet_levels}"
        )
    sizes = np.unique(level)[::-1]  # the smallest cells have the highest level
    edge = np.zeros(len(level), np.uint8)
    edge[np.isin(level, sizes[:smallest_levels])] = int(EdgeClass.SHARP)
    fillet = sizes[smallest_levels - fillet_levels : smallest_levels]
    edge[np.isin(level, fillet)] = int(EdgeClass.FILLET)
    return edge


def edges_by_radius(size: np.ndarray, tolerance: float, radius: float) -> np.ndarray:
    """Return the edge class of leaves by the radius that their size stands for.

    A cell of size s on a cylinder of radius r has the deviation s / (r sqrt 12), so a homogeneous
    cell smaller than sqrt(12) tolerance radius lies on something more curved than that radius.

    Args:
        size: Edge length of every leaf [mm], shape (C,).
        tolerance: Largest deviation of the normals in a cell (Eq. 4).
        radius: Smallest radius that is still a patch [mm].

    Returns:
        `EdgeClass` of every leaf, shape (C,), u8.
    """
    small = size < math.sqrt(12.0) * tolerance * radius
    return np.where(small, int(EdgeClass.SHARP), int(EdgeClass.NONE)).astype(np.uint8)
