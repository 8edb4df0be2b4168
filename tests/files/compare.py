"""Equality of groups of arrays, field by field."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np


def assert_equal(left: Any, right: Any, *, but: tuple[str, ...] = ()) -> None:
    """Assert that two dataclasses hold equal values of equal types; NaN equals NaN."""
    assert type(left) is type(right)
    for field in dataclasses.fields(left):
        if field.name in but:
            continue
        a, b = getattr(left, field.name), getattr(right, field.name)
        if isinstance(a, np.ndarray):
            assert isinstance(b, np.ndarray), field.name
            assert a.dtype == b.dtype, field.name
            np.testing.assert_array_equal(a, b, err_msg=field.name)
        elif dataclasses.is_dataclass(a) and field.name in ("cells", "fillets"):
            assert_equal(a, b)
        else:
            assert a == b, field.name


def as_stored(points: np.ndarray) -> np.ndarray:
    """Return points [mm] as single-precision metres keep them."""
    return (points / 1000.0).astype(np.float32).astype(np.float64) * 1000.0
