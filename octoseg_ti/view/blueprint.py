"""The layout of the Rerun viewer, as code: saved layouts do not survive its releases."""

from __future__ import annotations

from typing import Any

import numpy as np

from octoseg_ti.view.scene import Viewpoint

TABS = {
    "1 Scan": ("/world/scan/**", "/world/scanner/**"),
    "2 Normals": ("/world/normals/**",),
    "3 Initial grid": ("/world/octree/initial/**",),
    "4 Final grid": ("/world/octree/final/**",),
    "5 Edge points": ("/world/edges/points",),
    "6 Edges removed": ("/world/edges/removed",),
    "7 Segments": ("/world/segments/**",),
    "8 Surfaces": ("/world/surfaces/**",),
}
"""Name and contents of every tab, in the order of the method and of the paper's figures."""

TRUTH_TABS = {
    "9 Truth": ("/world/truth/**",),
    "10 Errors": ("/world/errors/**",),
}
"""Tabs that a recording with truth has besides."""

_BACKGROUND = (250, 250, 252, 255)


def blueprint(
    view: Viewpoint, *, truth: bool = False, result: bool = True, playing: bool = False
) -> Any:
    """Return the layout: a tab for every stage, all from one point of view, and a side panel.

    Args:
        view: Where to look from.
        truth: With the tabs of the truth.
        result: With the tabs of a segmentation, and its report beside them.
        playing: Open at the scan, where the stripes arrive, instead of at the result.
    """
    import rerun.blueprint as rrb

    names = dict(list(TABS.items())[: len(TABS) if result else 1])
    if truth:
        names.update(TRUTH_TABS if result else {"9 Truth": TRUTH_TABS["9 Truth"]})
    tabs = rrb.Tabs(
        *(_view(rrb, view, name, contents) for name, contents in names.items()),
        active_tab="7 Segments" if result and not playing else "1 Scan",
    )
    layout: Any = tabs
    if result:
        side = rrb.Vertical(
            rrb.TextDocumentView(origin="/report", name="Report"),
            rrb.BarChartView(origin="/metrics/segment_sizes", name="Points per patch"),
            rrb.BarChartView(origin="/metrics/milliseconds", name="Milliseconds per stage"),
            row_shares=[2, 1, 1],
        )
        layout = rrb.Horizontal(tabs, side, column_shares=[3, 1])
    # Paused, the viewer would open at the first stripe and show nothing but that.
    time = rrb.TimePanel(state="collapsed", timeline="scan_line", play_state="following")
    return rrb.Blueprint(layout, time, collapse_panels=True)


def _view(rrb: Any, view: Viewpoint, name: str, contents: tuple[str, ...]) -> Any:
    from_start = rrb.VisibleTimeRange(
        "scan_line",
        start=rrb.TimeRangeBoundary.infinite(),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    # Everything in the bounding sphere is in sight of the viewer's eye at this distance.
    eye = view.center - 1.8 * view.radius * np.asarray(view.direction)
    return rrb.Spatial3DView(
        origin="/world",
        contents=list(contents),
        name=name,
        background=_BACKGROUND,
        line_grid=False,
        # A stripe alone is a line in the void: all stripes up to the cursor stay in sight.
        time_ranges=from_start if name.startswith("1 ") else None,
        eye_controls=rrb.EyeControls3D(
            position=eye.tolist(), look_target=view.center.tolist(), eye_up=view.up.tolist()
        ),
    )
