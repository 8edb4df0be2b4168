"""Points to measure on, and means that outliers do not move: shared by stages that measure.

Both must not depend on the order of the views: points are chosen by their place in the stripe, and
values are sorted before they are added up.
"""

import numpy as np

_SAMPLES = 25_000
# Trimmed means instead of medians: coarse quantisation can make a median zero.
_TRIM = 0.75


def sample_stripes(start: np.ndarray, count: int = _SAMPLES) -> np.ndarray:
    """Return about so many points, evenly along every stripe from its first one.

    Args:
        start: First point of every stripe, and N at the end, shape (S + 1,), i32.
        count: How many points at least, where there are as many.

    Returns:
        Indices of points, ascending, i32.
    """
    step = max(1, int(start[-1]) // count)
    counts = -(-np.diff(start) // step)
    ends = np.cumsum(counts)
    within = np.arange(ends[-1], dtype=np.int32) - np.repeat(
        (ends - counts).astype(np.int32), counts
    )
    return np.repeat(start[:-1], counts) + np.int32(step) * within


def trimmed_mean(values: np.ndarray) -> float:
    """Return the mean of the lower three quarters of the non-negative values; 0 of none."""
    values = values[values >= 0]
    if len(values) == 0:
        return 0.0
    keep = max(1, int(_TRIM * len(values)))
    return float(np.mean(np.sort(values)[:keep], dtype=np.float64))
