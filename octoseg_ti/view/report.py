"""A report of one segmentation: what went in, what was chosen, what came out, how good it is.

The same sections are written as Markdown, for the attachment of a recording, and as one HTML file
with the pictures inside.
"""

from __future__ import annotations

import base64
import html
import importlib.metadata
import math
import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from octoseg_ti.alignment import Registration
from octoseg_ti.errors import DataError
from octoseg_ti.evaluation import Scores
from octoseg_ti.types import Segmentation, StopReason, SurfaceKind, Truth
from octoseg_ti.view.scene import finite_rows
from octoseg_ti.view.stream import replaced
from octoseg_ti.view.surface_text import surface_text

_PACKAGES = ("taichi", "numpy", "scipy", "rerun-sdk", "mcap", "pillow")


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A heading with paragraphs and a table under it."""

    title: str
    paragraphs: Sequence[str] = ()
    head: tuple[str, ...] = ()
    rows: Sequence[tuple[str, ...]] = ()


def sections(
    result: Segmentation,
    *,
    scores: Scores | None = None,
    truth: Truth | None = None,
    arch: str | None = None,
) -> list[Section]:
    """Return the content of the report.

    Args:
        result: The segmentation.
        scores: Its scores.
        truth: Truth of its points.
        arch: Arch that segmented; default: that of the Taichi of this process.
    """
    out = [
        _input(result, truth),
        _measured(result),
        _parameters(result),
        _stages(result),
        _grid(result),
        _patches(result),
    ]
    fillets = _fillets(result)
    if fillets is not None:
        out.append(fillets)
    if result.registration is not None:
        out.append(_registration(result.registration))
    if scores is not None:
        out += _scores(scores)
    out.append(_environment(arch))
    return out


def _input(result: Segmentation, truth: Truth | None) -> Section:
    points = result.points[finite_rows(result.points)]
    rows = [("points", f"{len(result):,}")]
    if len(points) < len(result):
        rows.append(("points that are not finite", f"{len(result) - len(points):,}"))
    if len(points):
        box = np.ptp(points, axis=0)
        rows.append(("bounding box", " x ".join(f"{side:.2f}" for side in box) + " mm"))
    if result.stripe is not None:
        rows.append(("stripes", f"{len(np.unique(result.stripe)):,}"))
    if result.view is not None:
        rows.append(("views", f"{len(np.unique(result.view)):,}"))
    if truth is not None:
        rows.append(("true patches", f"{truth.patch_count:,}"))
        rows += sorted(truth.info.items())
    return Section(title="Input", paragraphs=[result.name or "(no name)"], rows=rows)


def _measured(result: Segmentation) -> Section:
    m = result.measured
    return Section(
        title="Measured on the data",
        rows=[
            ("spacing along the stripes", f"{m.spacing_along:.4g} mm"),
            ("spacing across the stripes", f"{m.spacing_across:.4g} mm"),
            ("range noise (standard deviation)", f"{m.noise:.4g} mm"),
            ("deviation of the normals", f"{math.degrees(m.normal_noise):.3g} deg"),
            *([] if math.isnan(result.shallowest_edge) else [result.told_edges()]),
        ],
    )


def _registration(aligned: Registration) -> Section:
    rows = [
        (f"{a} - {b}", f"{count:,}", f"{before:.4f}", f"{after:.4f}")
        for (a, b), count, before, after in zip(
            aligned.pairs.tolist(), aligned.matches, aligned.before, aligned.after, strict=True
        )
    ]
    moves = [
        f"view {v}: {shift:.4f} mm, {math.degrees(angle):.4f} deg"
        for v, (shift, angle) in enumerate(zip(*aligned.moves(), strict=True))
    ]
    texts = [f"{aligned}.", "The poses were moved by: " + "; ".join(moves) + "."]
    head = ("views", "matched points", "rms before [mm]", "rms after [mm]")
    return Section(title="Registration", paragraphs=texts, head=head, rows=rows)


def _parameters(result: Segmentation) -> Section:
    rows = []
    for section, values in result.params.to_dict().items():
        for name, value in values.items():
            text = f"{value:.6g}" if isinstance(value, float) else str(value)
            text = "-" if value is None else text
            if name == "homogeneity" and value is not None:
                text += f" rad ({math.degrees(value):.3g} deg)"
            rows.append((f"{section}.{name}", text))
    text = "As given, or derived from what was measured."
    return Section(title="Parameters", paragraphs=[text], head=("parameter", "value"), rows=rows)


def _stages(result: Segmentation) -> Section:
    total = sum(s for name, s in result.seconds.items() if "." not in name)
    rows = []
    for name, seconds in [*result.seconds.items(), ("total", total)]:
        rate = f"{1e-6 * len(result) / seconds:.2f}" if seconds > 0 else "-"
        share = f"{seconds / total:.1%}" if total > 0 else "-"
        rows.append((name, f"{1e3 * seconds:.1f}", rate, share))
    text = (
        "Wall time of this run, with loading or compiling of the kernels that it was first to use."
    )
    head = ("stage", "ms", "Mpoints/s", "share")
    return Section(title="Stages", paragraphs=[text], head=head, rows=rows)


def _grid(result: Segmentation) -> Section:
    cells = result.cells
    rows = []
    for level in np.unique(cells.level):
        on = cells.level == level
        size = float(cells.size[on][0])
        rows.append((str(level), f"{size:.4g}", f"{on.sum():,}", f"{cells.count[on].sum():,}"))
    stops = [
        f"{StopReason(int(code)).name.lower().replace('_', ' ')} {np.sum(cells.stop == code):,}"
        for code in np.unique(cells.stop)
    ]
    return Section(
        title="Grid",
        paragraphs=[
            f"{len(cells):,} cells in {result.level_count} sizes after {result.passes} passes. "
            f"Cells by why they were not split further: {', '.join(stops) or 'none'}.",
            f"{np.count_nonzero(result.edge):,} edge points, {int(result.outlier.sum()):,} "
            f"outliers, {np.mean(result.labels >= 0) if len(result) else 0:.1%} of the points "
            "labelled.",
        ],
        head=("level", "cell [mm]", "cells", "points"),
        rows=rows,
    )


def _patches(result: Segmentation) -> Section:
    rows = []
    sizes, deviation = result.patch_sizes, result.deviation
    for k in range(result.patch_count):
        kind = SurfaceKind(int(result.kind[k]))
        rms = result.residual[k]
        rows.append(
            (
                str(k),
                kind.name.lower().replace("_", "-"),
                str(int(result.surface[k])),
                f"{sizes[k]:,}",
                "-" if np.isnan(rms) else f"{rms:.4f}",
                surface_text(kind, result.parameters[k], deviation[k]),
            )
        )
    head = ("patch", "kind", "surface", "points", "rms [mm]", "fitted")
    title = f"{result.patch_count} patches"
    text = (
        "Standard deviations (±) are those of the fit, for independent errors of the points; what "
        "stripes and views share is not in them."
    )
    shown = [text] if np.isfinite(deviation[:, 6:]).any() else []
    return Section(title=title, paragraphs=shown, head=head, rows=rows)


def _fillets(result: Segmentation) -> Section | None:
    found = result.fillets
    if found is None or len(found) == 0:
        return None
    rows = [
        (
            str(k),
            f"{found.radius[k]:.3f}",
            f"{found.deviation[k]:.3f}",
            "concave" if found.concave[k] else "convex",
            " and ".join(str(patch) for patch in found.patches[k]),
            f"{found.points[k]:,}",
            ", ".join(str(patch) for patch in np.flatnonzero(found.strip == k)) or "-",
        )
        for k in range(len(found))
    ]
    head = ("fillet", "radius [mm]", "deviation [mm]", "side", "between", "points", "strips")
    text = "Rounds that a ball leaves that touches two patches; strips are patches on such a round."
    title = f"{len(found)} fillets"
    return Section(title=title, paragraphs=[text], head=head, rows=rows)


def _scores(scores: Scores) -> list[Section]:
    out = [
        Section(
            title="Scores",
            paragraphs=[
                f"Regions match when they share at least {scores.overlap:.0%} of both (Hoover et "
                f"al. 1996). Interior points: {scores.interior_rule}."
            ],
            head=("", "all points", "interior"),
            rows=[(a.strip(), b, c) for a, b, c in scores.rows()],
        )
    ]
    if scores.edges:
        out.append(
            Section(
                title="Edge points",
                paragraphs=[
                    f"True edge points lie within {scores.edge_distance:.3g} mm of a true edge "
                    f"({scores.edge_distance_from})."
                ],
                head=("class", "found", "true", "precision", "recall", "F1"),
                rows=[
                    (
                        name,
                        f"{e.found:,}",
                        f"{e.true:,}",
                        *map(_ratio, (e.precision, e.recall, e.f1)),
                    )
                    for name, e in scores.edges.items()
                ],
            )
        )
    return out


def _ratio(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4f}"


def _environment(arch: str | None) -> Section:
    runtime = sys.modules.get("octoseg_ti.device.runtime")
    options = None if runtime is None else runtime.running()
    threads = ""
    if arch is None and options is not None:
        arch, threads = options.arch, f", {options.threads} threads"
    from octoseg_ti import __version__

    rows = [
        ("arch", "not known: Taichi did not run here" if arch is None else f"{arch}{threads}"),
        ("octoseg", __version__),
        ("Python", platform.python_version()),
        ("system", f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"),
    ]
    for package in _PACKAGES:
        try:
            rows.append((package, importlib.metadata.version(package)))
        except importlib.metadata.PackageNotFoundError:
            rows.append((package, "not installed"))
    return Section(title="Ran on", rows=rows)


def markdown(
    result: Segmentation,
    *,
    scores: Scores | None = None,
    truth: Truth | None = None,
    arch: str | None = None,
) -> str:
    """Return the report as Markdown text; arguments as `sections`."""
    lines = ["# octoseg report", ""]
    for section in sections(result, scores=scores, truth=truth, arch=arch):
        lines += [f"## {section.title}", ""]
        for paragraph in section.paragraphs:
            lines += [_cell(paragraph), ""]
        if section.rows:
            head = section.head or ("",) * len(section.rows[0])
            lines.append("| " + " | ".join(head) + " |")
            lines.append("|" + "---|" * len(head))
            lines += ["| " + " | ".join(map(_cell, row)) + " |" for row in section.rows]
            lines.append("")
    return "\n".join(lines)


def _cell(text: str) -> str:
    return text.replace("\\", "\\\\").replace("|", "\\|").replace("\n", " ")


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #1d232b; max-width: 1100px;
       margin: 2rem auto; padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.15rem; margin-top: 2rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .2rem .8rem; border-bottom: 1px solid #dde2e8; text-align: right; }
th:first-child, td:first-child { text-align: left; }
.pictures { display: grid; grid-template-columns: repeat(auto-fill, minmax(320px, 1fr));
            gap: 1rem; }
figure { margin: 0; } figure img { width: 100%; border: 1px solid #dde2e8; }
figcaption { font-size: .9rem; }
"""


def page(
    result: Segmentation,
    *,
    scores: Scores | None = None,
    truth: Truth | None = None,
    arch: str | None = None,
    pictures: dict[str, np.ndarray] | None = None,
) -> str:
    """Return the report as one HTML page that needs no other file.

    Args:
        result: The segmentation.
        scores: Its scores.
        truth: Truth of its points.
        arch: As in `sections`.
        pictures: Pictures by name; default: those of `octoseg_ti.view.figures`.
    """
    from octoseg_ti.view.figures import TITLES, figures, png

    if pictures is None:
        pictures = figures(result, truth=truth, width=720, height=480)
    title = f"octoseg report: {result.name}" if result.name else "octoseg report"
    parts = [
        "<!doctype html>",
        '<html lang="en"><head><meta charset="utf-8">',
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>",
        f"<h1>{html.escape(title)}</h1>",
        '<div class="pictures">',
    ]
    for name, picture in pictures.items():
        caption = html.escape(TITLES.get(name, name))
        data = base64.b64encode(png(picture)).decode("ascii")
        parts.append(
            f'<figure><img alt="{caption}" src="data:image/png;base64,{data}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    parts.append("</div>")
    for section in sections(result, scores=scores, truth=truth, arch=arch):
        parts.append(f"<h2>{html.escape(section.title)}</h2>")
        parts += [f"<p>{html.escape(text)}</p>" for text in section.paragraphs]
        if section.rows:
            parts.append("<table>")
            if section.head:
                parts.append(_html_row("th", section.head))
            parts += [_html_row("td", row) for row in section.rows]
            parts.append("</table>")
    parts.append("</body></html>")
    return "\n".join(parts)


def _html_row(tag: str, cells: tuple[str, ...]) -> str:
    return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def write_report(
    path: str | Path,
    result: Segmentation,
    *,
    scores: Scores | None = None,
    truth: Truth | None = None,
    arch: str | None = None,
    pictures: dict[str, Any] | None = None,
) -> list[Path]:
    """Write report.html, with its pictures inside, and report.md.

    Args:
        path: Folder, which is made if need be; or a name ending in .html or .md, whose other half
            is written beside it.
        result: The segmentation.
        scores: Its scores.
        truth: Truth of its points, for two more pictures.
        arch: As in `sections`.
        pictures: As in `page`.

    Returns:
        The two files.

    Raises:
        DataError: They cannot be written.
    """
    path = Path(path)
    stem = path.with_suffix("") if path.suffix in (".html", ".md") else path / "report"
    texts = {
        stem.with_name(stem.name + ".html"): page(
            result, scores=scores, truth=truth, arch=arch, pictures=pictures
        ),
        stem.with_name(stem.name + ".md"): markdown(result, scores=scores, truth=truth, arch=arch),
    }
    for target, text in texts.items():
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            what = f"cannot be written: {error.strerror or error}"
            raise DataError(what, path=target) from error
        with replaced(target) as part:
            part.write_text(text, encoding="utf-8")
    return list(texts)
