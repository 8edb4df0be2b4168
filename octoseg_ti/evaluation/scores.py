"""What `evaluate` answers, as numbers, as a dictionary for JSON and as a table to read."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from octoseg_ti.evaluation.overlap import HooverCounts, Overlap, hoover


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionScores:
    """How well the predicted regions are the true patches; points of unknown truth take no part."""

    points: int
    """Points whose true patch is known."""
    patches: int
    """True patches."""
    regions: int
    """Predicted regions that hold a point of known truth."""
    correct: int
    """See `HooverCounts`."""
    over: int
    """See `HooverCounts`."""
    under: int
    """See `HooverCounts`."""
    missed: int
    """See `HooverCounts`."""
    noise: int
    """See `HooverCounts`."""
    on_unknown: int
    """Predicted regions of which more than half the points have no true patch. One of these is in
    the counts above only by its points of known truth, and in none of them without any."""
    mean_iou: float
    """Mean over the patches of the IoU with the matched region (Hungarian; unmatched = 0)."""
    ari: float
    """Adjusted Rand index; the points without a region form one cluster."""
    ari_labelled: float
    """Adjusted Rand index of the points with a region alone."""
    labelled: float
    """Share of the points that have a region, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalScores:
    """Angle between estimated and true normals, without regard to their sign [rad]."""

    points: int
    """Points whose true normal is known."""
    mean: float
    """Mean angle [rad]."""
    median: float
    """Median angle [rad]."""
    p95: float
    """95th percentile [rad]."""
    missing: float
    """Share of points without an estimate, 0..1; each counts as a right angle."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeScores:
    """How well points near true edges were found."""

    found: int
    """Points called edge points."""
    true: int
    """Points within the distance of a true edge."""
    precision: float
    """Share of the points called edge points that are within the distance of a true edge."""
    recall: float
    """Share of the points within the distance of a true edge that were called edge points."""
    f1: float
    """Harmonic mean of precision and recall."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FilletScores:
    """How well the radii of fillets were found.

    A fillet is right when more than half of its points lie on true fillets; then the error of its
    radius is told, relative to the median of their true radii.
    """

    found: int
    """Fillets found."""
    right: int
    """Those that are right."""
    median: float
    """Median of the relative errors of their radii, without sign; NaN = none is right."""
    worst: float
    """Largest such error."""
    within_5: float
    """Share of the points on right fillets whose radius is within 5 %."""
    within_10: float
    """... and within 10 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArtefactScores:
    """How well cleaning found the artefacts of the measurement."""

    found: int
    """Points marked as outliers."""
    true: int
    """Points with an artefact."""
    precision: float
    """Share of the marked points that have an artefact."""
    recall: float
    """Share of the points with an artefact that were marked."""
    f1: float
    """Harmonic mean of precision and recall."""
    classes: dict[str, tuple[int, float]]
    """Points and recall of every class of artefact: "mixed", "spike", "multi-bounce"."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scores:
    """The answer of `evaluate`. ``*_interior`` leaves the points near edges out."""

    overlap: float
    """Overlap T of the five counts."""
    edge_distance: float | None
    """Distance d within which a point counts as an edge point [mm]; None = not determined."""
    edge_distance_from: str
    """Where d comes from."""
    interior_rule: str
    """Which points count as interior."""
    regions: RegionScores
    """Regions against patches, all points."""
    regions_interior: RegionScores | None
    """The same without the points near edges; None when nothing tells where the edges are."""
    normals: NormalScores | None
    """Error of the normals, all points; None without estimated or true normals."""
    normals_interior: NormalScores | None
    """The same without the points near edges."""
    edges: dict[str, EdgeScores]
    """Scores of edge points under "all", "sharp" and "fillet"; empty without true edges."""
    edges_note: str
    """Why edge points were not scored; empty when they were."""
    fillets: FilletScores | None = None
    """Scores of the radii of fillets; None when the result or the truth has none."""
    artefacts: ArtefactScores | None = None
    """Scores of cleaning; None when the truth does not know artefacts or the result no outliers."""
    table: Overlap
    """Overlaps of patches and regions, all points."""
    table_interior: Overlap | None
    """Overlaps of patches and regions without the points near edges."""

    @property
    def perfect(self) -> bool:
        """Whether every patch is correct, and nothing is over, under, missed or noise."""
        r = self.regions
        return r.correct == r.patches > 0 and r.over + r.under + r.missed + r.noise == 0

    def sweep(
        self, thresholds: np.ndarray | None = None, *, interior: bool = False
    ) -> list[tuple[float, HooverCounts]]:
        """Return the five counts at every overlap T.

        Args:
            thresholds: Values of T; default 0.51, 0.52 ... 0.95.
            interior: Without the points near edges.

        Raises:
            ValueError: There are no interior scores, or a T is not in (0.5, 1].
        """
        table = self.table_interior if interior else self.table
        if table is None:
            raise ValueError(f"no interior scores: {self.interior_rule}")
        values = np.arange(51, 96) / 100 if thresholds is None else np.asarray(thresholds, float)
        if not ((values > 0.5) & (values <= 1)).all():
            raise ValueError("every overlap must be above 0.5 and at most 1")
        return [(float(t), hoover(table, float(t))) for t in values]

    def to_dict(self) -> dict[str, Any]:
        """Return plain nested values for JSON: angles in degrees (``*_deg``), NaN as None."""
        return {
            "overlap": self.overlap,
            "edge_distance_mm": _plain(self.edge_distance),
            "edge_distance_from": self.edge_distance_from,
            "interior_rule": self.interior_rule,
            "edges_note": self.edges_note,
            "regions": _region_dict(self.regions),
            "regions_interior": _region_dict(self.regions_interior),
            "normals": _normal_dict(self.normals),
            "normals_interior": _normal_dict(self.normals_interior),
            "edges": {
                name: {k: _plain(v) for k, v in dataclasses.asdict(score).items()}
                for name, score in self.edges.items()
            },
            "fillets": (
                None
                if self.fillets is None
                else {k: _plain(v) for k, v in dataclasses.asdict(self.fillets).items()}
            ),
            "artefacts": _artefact_dict(self.artefacts),
        }

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the lines of the table: (what, all points, interior points)."""
        a, b = self.regions, self.regions_interior
        out = [("points with known patch", _count(a, "points"), _count(b, "points"))]
        out.append(("true patches", _count(a, "patches"), _count(b, "patches")))
        out.append(("regions found", _count(a, "regions"), _count(b, "regions")))
        for name, text in _COUNTS.items():
            out.append((text, _count(a, name), _count(b, name)))
        out.append(("mean IoU", _number(a, "mean_iou"), _number(b, "mean_iou")))
        out.append(("adjusted Rand index", _number(a, "ari"), _number(b, "ari")))
        out.append(
            ("  labelled points only", _number(a, "ari_labelled"), _number(b, "ari_labelled"))
        )
        out.append(("points labelled", _share(a, "labelled"), _share(b, "labelled")))
        if self.normals is not None:
            n, m = self.normals, self.normals_interior
            out.append(("normal error, median", _degrees(n, "median"), _degrees(m, "median")))
            out.append(("normal error, 95 %", _degrees(n, "p95"), _degrees(m, "p95")))
            out.append(("points without a normal", _share(n, "missing"), _share(m, "missing")))
        return out

    def __str__(self) -> str:
        """Return a table that needs no manual."""
        rows = self.rows()
        width = max(len(row[0]) for row in rows)
        lines = [f"{'':{width}}  {'all':>10}  {'interior':>10}"]
        lines += [f"{a:{width}}  {b:>10}  {c:>10}" for a, b, c in rows]
        lines.append(
            f"regions match when they share {self.overlap:.0%} of both; "
            f"interior: {self.interior_rule}"
        )
        if self.edges:
            lines.append(f"{'edge points':{width}}  {'precision':>10}  {'recall':>10}  {'F1':>10}")
            for name, e in self.edges.items():
                lines.append(
                    f"{'  ' + name:{width}}  {_value(e.precision):>10}  {_value(e.recall):>10}"
                    f"  {_value(e.f1):>10}"
                )
            lines.append(
                f"edge point: within {self.edge_distance:.3g} mm of a true edge "
                f"({self.edge_distance_from})"
            )
        else:
            lines.append(f"edge points: not scored ({self.edges_note})")
        if self.fillets is not None:
            f = self.fillets
            lines.append(
                f"fillets: {f.found} found, {f.right} right; error of the radius: median "
                f"{f.median:.1%}, largest {f.worst:.1%}; within 5 % for {f.within_5:.1%} of their "
                f"points, within 10 % for {f.within_10:.1%}"
            )
        if self.artefacts is not None:
            a = self.artefacts
            lines.append(f"{'cleaning':{width}}  {'precision':>10}  {'recall':>10}  {'F1':>10}")
            lines.append(
                f"{'  all artefacts':{width}}  {_value(a.precision):>10}  {_value(a.recall):>10}"
                f"  {_value(a.f1):>10}"
            )
            for name, (points, recall) in a.classes.items():
                what = f"  {name}, {points} points"
                lines.append(f"{what:{width}}  {'':>10}  {_value(recall):>10}")
        return "\n".join(lines)


_COUNTS = {
    "correct": "  correct",
    "over": "  over-segmented",
    "under": "  under-segmented",
    "missed": "  missed patches",
    "noise": "  noise regions",
    "on_unknown": "  on unknown points",
}


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _region_dict(scores: RegionScores | None) -> dict[str, Any] | None:
    if scores is None:
        return None
    return {k: _plain(v) for k, v in dataclasses.asdict(scores).items()}


def _normal_dict(scores: NormalScores | None) -> dict[str, Any] | None:
    if scores is None:
        return None
    angles = {f"{k}_deg": math.degrees(getattr(scores, k)) for k in ("mean", "median", "p95")}
    return {"points": scores.points, **angles, "missing": scores.missing}


def _artefact_dict(scores: ArtefactScores | None) -> dict[str, Any] | None:
    if scores is None:
        return None
    values = {k: _plain(v) for k, v in dataclasses.asdict(scores).items() if k != "classes"}
    classes = {
        name: {"true": points, "recall": _plain(recall)}
        for name, (points, recall) in scores.classes.items()
    }
    return {**values, "classes": classes}


def _count(scores: Any, name: str) -> str:
    return "-" if scores is None else str(getattr(scores, name))


def _value(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _number(scores: Any, name: str) -> str:
    return "-" if scores is None else _value(getattr(scores, name))


def _share(scores: Any, name: str) -> str:
    return "-" if scores is None else f"{getattr(scores, name):.1%}"


def _degrees(scores: Any, name: str) -> str:
    return "-" if scores is None else f"{math.degrees(getattr(scores, name)):.3f} deg"
