"""A made part for all tests of the views."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
import made as _made


@pytest.fixture(scope="session")
def made():
    """Return (scans, truth, segmentation) of the plate at 0.5 mm, in two views."""
    scans, truth = _made.scan(0.5, views=2)
    return scans, truth, _made.segmentation(scans, truth)
