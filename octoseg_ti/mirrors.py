"""Mirror images that look like faces: regions that their view cannot have seen.

A glossy part mirrors the laser line, and the probe takes the second spot for one on the line. Such
points make smooth sheets of their own, which no rule about neighbours tells from faces. But they
are seen from one view only, and most lie behind the face that mirrored them, so that their lines of
sight pass through it. (Those that seem to float in front of the part stay: nothing blocks them.)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from octoseg_ti.arrange import Arranged
from octoseg_ti.device import runtime
from octoseg_ti.patches import Regions
from octoseg_ti.stages.grid import Grid
from octoseg_ti.stages.leaves import members_of, sizes_of
from octoseg_ti.stages.sets import spread
from octoseg_ti.stages.sight import blocked_lines
from octoseg_ti.types import NONE

# A region is of one view when so many of its points are, the rest being strays.
_ONE_VIEW = 0.8
# Lines of sight that speak for a region, at most; the share of them, and the number, that are
# blocked where it is a mirror image: of images it is half to all, of faces one in twenty at most.
_LINES, _SHARE, _FEWEST = 64, 0.25, 4
# What is this near to a point does not block its line, and so near to a line a point blocks it, in
# smallest cells: nearly two spacings, and nearly one.
_CLEAR, _REACH = 1.0, 0.5


def without_mirror_images(
    grid: Grid, found: Regions, arranged: Arranged, probe: np.ndarray
) -> Regions:
    """Return the regions without those that are mirror images; their points have no label.

    Args:
        grid: The sparse grid.
        found: The regions.
        arranged: The points that went into the grid, with their runs.
        probe: Where the probe was at every run [mm], world frame, shape (S, 3); NaN = not known.
    """
    gone = _mirrored(grid, found, arranged, probe)
    if not gone.any():
        return found
    number = np.full(found.count + 1, NONE, np.int32)
    kept = np.flatnonzero(~gone)
    number[kept] = np.arange(len(kept), dtype=np.int32)
    return replace(
        found,
        label=number.take(found.label),
        cell_label=number[found.cell_label],
        count=len(kept),
        surface=None if found.surface is None else found.surface[kept],
        mirrored=np.append(gone, False).take(found.label),
    )


def _mirrored(grid: Grid, found: Regions, arranged: Arranged, probe: np.ndarray) -> np.ndarray:
    """Say of every region whether it is a mirror image, shape (K,), bool."""
    assert arranged.run is not None
    label, regions = found.label, found.count
    views = int(arranged.view.max()) + 1
    in_scans = label.take(runtime.download(grid.place))
    seen = sizes_of((in_scans + 1) * views + arranged.view, (regions + 1) * views)
    seen = seen.reshape(regions + 1, views)[1:]  # what has no region comes first
    size = seen.sum(axis=1)
    # Nothing larger blocks the largest region.
    asked = (seen.max(axis=1, initial=0) >= _ONE_VIEW * size) & (size < size.max(initial=0))
    if not asked.any():
        return asked
    # Of every region a few points, evenly: leaves are small along its rim, and lines of sight there
    # pass close by what hides the rest of the face.
    inside = np.flatnonzero(np.append(asked, False).take(label))
    few = [spread(members, _LINES) for members in members_of(label.take(inside), regions)]
    chosen = inside[np.concatenate(few)]
    place = probe[arranged.run[runtime.download(grid.order)[chosen]]]
    known = np.isfinite(place).all(axis=1)
    chosen, place = chosen[known], place[known]
    own = label[chosen]
    finest = grid.size / 2.0**grid.depth
    blocked = blocked_lines(
        grid,
        place - grid.corner,
        runtime.download(grid.point)[chosen],
        size[own],
        label,
        size,
        clear=_CLEAR * finest,
        reach=_REACH * finest,
    )
    lines = np.bincount(own, minlength=regions)
    against = np.bincount(own[blocked], minlength=regions)
    return np.asarray((against >= _FEWEST) & (against >= _SHARE * lines))
