"""The report holds the numbers, and nothing in a name can break it."""

import dataclasses
import html.parser

import numpy as np
import pytest

from octoseg_ti import DataError, __version__, evaluate
from octoseg_ti.view import report


class Tables(html.parser.HTMLParser):
    """Collects the cells of all tables, the pictures and what is left open."""

    def __init__(self):
        super().__init__()
        self.rows, self.images, self.open = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th"):
            self.rows[-1].append("")
        if tag == "img":
            self.images.append(dict(attrs))
        elif tag != "meta":
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data


def parse(text):
    tables = Tables()
    tables.feed(text)
    assert tables.open == []
    return tables


def test_html_holds_the_numbers(made):
    _, truth, result = made
    scores = evaluate(result, truth)
    page = parse(report.page(result, scores=scores, truth=truth))
    rows = {row[0]: row[1:] for row in page.rows}
    assert rows["points"] == [f"{len(result):,}"]
    assert rows["range noise (standard deviation)"] == ["0.01 mm"]
    assert rows["deviation of the normals"] == ["1.15 deg"]
    assert rows["grid.tolerance"] == ["0.01"]
    assert rows["regions.homogeneity"] == ["-"]
    assert rows["grid"][0] == "34.0"
    assert rows["total"] == ["51.0", "0.19", "100.0%"]  # 12 + 34 + 5, without the nested stage
    assert rows["2"][:2] in (["sphere", "2"], ["2", f"{np.sum(result.cells.level == 2):,}"])
    assert rows["correct"][0] == str(scores.regions.correct)
    assert rows["mean IoU"] == [f"{scores.regions.mean_iou:.4f}",
                                f"{scores.regions_interior.mean_iou:.4f}"]  # fmt: skip
    assert rows["sharp"][2] == f"{scores.edges['sharp'].precision:.4f}"
    assert rows["octoseg"] == [__version__]
    assert rows["part"] == ["plate"]
    spheres = [row for row in page.rows if len(row) == 6 and row[1] == "sphere"]
    assert spheres[0][3:5] == [f"{result.patch_sizes[2]:,}", "0.0035"]
    assert spheres[0][5].startswith("radius 10.000 ± 0.012 mm")
    assert len(page.images) == 9
    assert all(i["src"].startswith("data:image/png;base64,iVBOR") for i in page.images)


def test_pictures_may_be_given_or_left_out(made):
    page = parse(report.page(made[2], pictures={"scan": np.zeros((4, 5, 3), np.uint8)}))
    assert [i["alt"] for i in page.images] == ["Scan"]
    assert parse(report.page(made[2], pictures={})).images == []


def test_names_are_escaped(made):
    name = '<script>alert("x")</script> | a&b'
    result = dataclasses.replace(made[2], name=name)
    page = report.page(result, pictures={})
    assert "<script>" not in page
    assert "\\| a&b" in report.markdown(result)


def test_markdown_tables_are_rectangular(made):
    _, truth, result = made
    text = report.markdown(result, scores=evaluate(result, truth), truth=truth, arch="cpu")
    widths = [line.count("|") for line in text.splitlines() if line.startswith("|")]
    assert len(widths) > 60
    block = 0
    for line in text.splitlines():
        if not line.startswith("|"):
            block = 0
            continue
        block = block or line.count("|")
        assert line.count("|") == block, line
    assert "| arch | cpu |" in text
    assert "0.010" in text or "0.01 mm" in text


def test_the_arch_is_not_made_up(made):
    import sys

    runtime = sys.modules.get("octoseg_ti.device.runtime")
    running = runtime.running() if runtime else None
    text = report.markdown(made[2])
    assert ("not known" in text) == (running is None)


def test_files(made, tmp_path):
    paths = report.write_report(tmp_path / "new" / "folder", made[2], pictures={})
    assert [p.name for p in paths] == ["report.html", "report.md"]
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == [
        "report.html", "report.md",
    ]  # fmt: skip
    paths = report.write_report(tmp_path / "block.v2.html", made[2], pictures={})
    assert [p.name for p in paths] == ["block.v2.html", "block.v2.md"]
    (tmp_path / "file").write_text("x")
    with pytest.raises(DataError, match="cannot be written"):
        report.write_report(tmp_path / "file", made[2], pictures={})


def test_an_empty_result(made):
    result = made[2]
    none = dataclasses.replace(
        result, labels=np.full(len(result), -1, np.int32), kind=np.zeros(0, np.int8),
        surface=np.zeros(0, np.int32), parameters=np.zeros((0, 8)),
        covariance=np.zeros((0, 8, 8)), residual=np.zeros(0), seconds={},
    )  # fmt: skip
    text = report.markdown(none)
    assert "0 patches" in text and "0.0% of the points" in text
