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
    counts = (start[1:] - start[:-1] + (step - 1)) // step
    ends = np.cumsum(counts)
    # Where every stripe would begin if one row of steps went through all of them.
    offset = start[:-1] - step * (ends - counts)
    steps = np.arange(0, step * int(ends[-1]), step, dtype=np.int32)
    return steps + np.repeat(offset.astype(np.int32), counts)


def ascending(values: np.ndarray) -> np.ndarray:
    """Return the non-negative values in ascending order."""
    values = np.sort(values)  # faster than to pick them first; NaN come last
    zero, infinite = values.dtype.type(0), values.dtype.type(np.inf)
    return values[values.searchsorted(zero) : values.searchsorted(infinite, side="right")]


def median(values: np.ndarray) -> float:
    """Return the median of the non-negative values; 0 if there are none."""
    values = ascending(values)  # faster than `numpy.median`
    middle = values[(len(values) - 1) // 2 : len(values) // 2 + 1]
    return float(middle.mean()) if len(values) else 0.0


def trimmed_mean(values: np.ndarray) -> float:
    """Return the mean of the lower three quarters of the non-negative values; 0 of none."""
    values = ascending(values)
    if len(values) == 0:
        return 0.0
    keep = max(1, int(_TRIM * len(values)))
    return float(np.mean(values[:keep], dtype=np.float64))
