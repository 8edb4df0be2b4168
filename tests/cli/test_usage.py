"""Wrong usage is exit code 2 and one line that helps; help and version are cheap."""

from __future__ import annotations

import pytest

from octoseg_ti.cli import VERBS


def test_bare_call_prints_the_verbs(octoseg) -> None:
    outcome = octoseg()
    assert outcome.code == 2
    assert all(verb in outcome.out for verb in VERBS)


@pytest.mark.parametrize("flag", ["--help", "-h", "help"])
def test_help_lists_every_verb(octoseg, flag: str) -> None:
    outcome = octoseg(flag)
    assert outcome.code == 0
    assert all(f"  {verb} " in outcome.out for verb in VERBS)
    assert outcome.err == ""


def test_version(octoseg) -> None:
    from octoseg_ti import __version__

    assert octoseg("--version").out == f"octoseg {__version__}\n"


@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_explains_itself(octoseg, verb: str) -> None:
    outcome = octoseg(verb, "--help")
    assert outcome.code == 0
    assert outcome.out.startswith(f"usage: octoseg {verb}")
    assert f"octoseg {verb}" in outcome.out.split("\n", 2)[2], "an example"
    assert outcome.err == ""


@pytest.mark.parametrize("verb", VERBS)
def test_every_option_has_a_help_text(verb: str) -> None:
    import dataclasses
    from importlib import import_module

    from octoseg_ti.cli.parse import _field_docs

    options = import_module(f"octoseg_ti.cli.{VERBS[verb][0]}").OPTIONS[verb]
    docs = _field_docs(options)
    nested = {"machine", "params", "scanner", "solid"}
    for item in dataclasses.fields(options):
        assert item.name in nested or docs.get(item.name), f"{verb}: {item.name}"


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["segmnt"], ["no verb 'segmnt'", "did you mean 'segment'"]),
        (["frobnicate"], ["no verb 'frobnicate'", "octoseg --help"]),
        (["segment"], ["missing IN"]),
        (["segment", "a.npz"], ["-o OUT"]),
        (["segment", "a.npz", "b.npz", "-o", "c.npz"], ["b.npz"]),
        (["segment", "a.npz", "-o", "c.npz", "--tpic", "x"], ["--tpic", "did you mean '--topic'"]),
        (
            ["segment", "a.npz", "-o", "c.npz", "--params.grid.tolerence", "0.1"],
            ["did you mean '--params.grid.tolerance'"],
        ),
        (["segment", "a.npz", "-o", "c.npz", "--preset", "papr"], ["papr", "paper"]),
        (["segment", "a.npz", "-o", "c.npz", "--params.grid.tolerance", "x"], ["FLOAT, not 'x';"]),
        (
            ["segment", "a.npz", "-o", "c.npz", "--params.surfaces.noise", "-1"],
            ["--params.surfaces.noise must be at least 0, not -1"],
        ),
        (["segment", "a.npz", "-o", "c.npz", "--arch", "gpu"], ["gpu", "vulkan"]),
        (["segment", __file__, "-o", "c.docx"], [".docx", ".mcap"]),
        (["segment", __file__, "-o", "c.npz", "--threads", "0"], ["--threads", "at least 1"]),
        (["simulate", "-o", "c.mcap"], ["missing PART"]),
        (["simulate", "test-block"], ["missing", "--output"]),
        (["simulate", "test-blok", "-o", "c.mcap"], ["did you mean 'test-block'", "phone"]),
        (["simulate", "two-planes", "-o", "c.step"], [".step", ".mcap"]),
        (["simulate", "part.docx", "-o", "c.mcap"], ["part.docx", "test-block", ".step .stp .stl"]),
        (["simulate", "part.stl", "-o", "c.mcap", "--unit", "yard"], ["yard", "inch"]),
        (["evaluate"], ["missing FILE"]),
        (["evaluate", __file__, "--overlap", "0.4"], ["--overlap", "0.5"]),
        (["profile", __file__, "--repeat", "0"], ["--repeat"]),
        (["profile", __file__, "--trace", "t.csv"], [".csv", ".json"]),
        (["info"], ["missing FILE"]),
        (["check"], ["missing FILE"]),
        (["convert", __file__], ["missing OUT"]),
        (["convert", __file__, "b.docx"], [".docx"]),
        (["play", __file__, "--lines", "5:2"], ["--lines"]),
        (["play", __file__, "--lines", "five"], ["--lines"]),
        (["play", __file__, "--every", "0"], ["--every"]),
        (["play", __file__, "--rate", "nan"], ["--rate"]),
        (["play", __file__, "--headless", "--spawn"], ["--headless", "--spawn"]),
        (["play", __file__, "--headless", "--loop", "2"], ["--loop"]),
        (["demo", "--part", "blok"], ["no part 'blok'", "test-block"]),
        (["simulate", "random:x", "-o", "a.npz"], ["seed", "'x'", "random:17"]),
        (["simulate", "random:1:round", "-o", "a.npz"], ["'round'", "sharp, filleted, smooth"]),
    ],
)
def test_wrong_usage_is_one_line(octoseg, arguments: list[str], wanted: list[str]) -> None:
    outcome = octoseg(*arguments)
    assert outcome.code == 2, outcome.err
    assert outcome.out == ""
    for part in wanted:
        assert part in outcome.complaint


def test_preset_sets_the_defaults_of_the_parameters() -> None:
    from octoseg_ti.cli.parse import parse
    from octoseg_ti.cli.segment import SegmentOptions
    from octoseg_ti.params import Params, paper

    base = ["a.npz", "-o", "b.npz"]
    assert parse("segment", SegmentOptions, base).params == Params()
    assert parse("segment", SegmentOptions, [*base, "--preset", "paper"]).params == paper()
    assert parse("segment", SegmentOptions, [*base, "--preset=paper"]).params == paper()
    steered = parse(
        "segment", SegmentOptions, [*base, "--preset", "paper", "--params.grid.divisions", "7"]
    )
    assert steered.params == paper(divisions=7)


def test_angles_are_degrees_on_the_command_line() -> None:
    import math

    from octoseg_ti.cli.parse import parse
    from octoseg_ti.cli.segment import SegmentOptions

    arguments = ["a.npz", "-o", "b.npz", "--params.regions.homogeneity-deg", "30"]
    angle = parse("segment", SegmentOptions, arguments).params.regions.homogeneity
    assert angle == math.radians(30)


def test_scanner_options_keep_their_defaults_to_the_last_bit() -> None:
    from octoseg_ti.cli.parse import parse
    from octoseg_ti.cli.simulate import SimulateOptions
    from scanner_sim import StripeScanner

    plain = parse("simulate", SimulateOptions, ["phone", "-o", "a.mcap"])
    assert plain.scanner == StripeScanner()
    noisy = parse("simulate", SimulateOptions, ["phone", "-o", "a.mcap", "--range-noise", "0.5"])
    assert noisy.scanner == StripeScanner(range_noise=0.5)


def test_several_outputs() -> None:
    from pathlib import Path

    from octoseg_ti.cli.parse import parse
    from octoseg_ti.cli.segment import SegmentOptions

    options = parse("segment", SegmentOptions, ["a.npz", "-o", "b.npz", "--output", "c.ply"])
    assert options.output == (Path("b.npz"), Path("c.ply"))


def test_arguments_need_no_slow_import() -> None:
    import subprocess
    import sys

    code = (
        "import sys\n"
        "from octoseg_ti.cli.parse import parse\n"
        "from octoseg_ti.cli.segment import SegmentOptions\n"
        "parse('segment', SegmentOptions, ['a.npz', '-o', 'b.npz', '--threads', '2'])\n"
        "print([m for m in ('typeguard', 'rich', 'taichi', 'asyncio') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
