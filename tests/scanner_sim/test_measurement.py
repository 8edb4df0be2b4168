"""Simulated scans with the effects of a real probe: artefacts, laws, streams, determinism."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from octoseg_ti.errors import DataError
from octoseg_ti.types import Artefact, Scans, Truth
from scanner_sim import StripeScanner, View, blocks, simulate
from scanner_sim.acceptance import scan_of_step
from scanner_sim.optics import brightness, noise_law
from scanner_sim.part import Part, box, difference, half_space, intersection, rod, sphere, union
from scanner_sim.presets import LIMITS, SCANNERS, scanner
from scanner_sim.quadric import distance
from scanner_sim.scanner import EFFECTS

VIEWS = (View(), View(tilt=0.9, azimuth=0.4))


def _part() -> Part:
    body = difference(box((-8, -6, 0), (8, 6, 5)), rod((3, 0, 3), (3, 0, 9), 3.0))
    return union(body, sphere((-4, 0, 4), 2.5))


def _coarse(name: str, **changes: object) -> StripeScanner:
    values = {"stripe_pitch": 0.2, "point_pitch": 0.15, "views": VIEWS, **changes}
    return scanner(name, **values)


def _world(scans: Scans) -> np.ndarray:
    assert scans.T_world_view is not None and scans.view is not None
    pose = scans.T_world_view[scans.view]
    world: np.ndarray = np.einsum("nij,nj->ni", pose[:, :3, :3], scans.points) + pose[:, :3, 3]
    return world


def _budget(probe: StripeScanner, scans: Scans, truth: Truth) -> tuple[np.ndarray, np.ndarray]:
    """Error along the line of sight, and four stated deviations plus the stage's errors."""
    assert truth.normal is not None and truth.position is not None and scans.stripe is not None
    assert scans.stripe_origin is not None and scans.T_world_view is not None
    axes = scans.T_world_view[scans.view][:, :3, :3]
    source = scans.stripe_origin[scans.stripe]
    sight = truth.position - source
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    back = source + axes @ probe.camera - truth.position
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    cosine = np.maximum(-np.einsum("ij,ij->i", sight, truth.normal), 0.02)
    facing = np.maximum(np.einsum("ij,ij->i", back, truth.normal), 0.02)
    law = noise_law(probe, cosine, facing, brightness(probe, sight, truth.normal, back))
    slope = np.abs(np.einsum("ij,ij->i", truth.normal, axes[:, :, 0])) / cosine
    error = np.einsum("ij,ij->i", _world(scans) - truth.position, truth.normal) / cosine
    limit = 4.0 * np.hypot(law, slope * probe.encoder_jitter)
    return error, limit + slope * (probe.encoder_error + probe.backlash) + 1e-3


@pytest.mark.parametrize("name", ["surveyor-like", "modern", "harsh"])
def test_clean_points_lie_on_their_surface_and_artefacts_do_not(name: str) -> None:
    probe = _coarse(name)
    scans, truth = simulate(_part(), probe, seed=2)
    assert truth.artefact is not None and truth.artefact.dtype == np.uint8
    assert truth.surface is not None and truth.position is not None
    # The truth lies on the part, whatever was measured.
    surfaces = _part().flat().surfaces
    assert np.abs(distance(surfaces, truth.surface, truth.position)).max() < 1e-9
    error, limit = _budget(probe, scans, truth)
    clean = truth.artefact == Artefact.CLEAN
    assert clean.sum() > 3000
    # Four deviations: 6 in 100,000 by chance, some more by the half deviation that clean allows.
    assert (np.abs(error[clean]) > limit[clean]).mean() < 3e-4
    mixed = truth.artefact == Artefact.MIXED
    assert 0.001 < mixed.mean() < 0.08
    assert np.abs(error[mixed]).mean() > 1.5 * np.abs(error[clean]).mean()
    spikes = truth.artefact == Artefact.SPIKE
    assert (truth.patch[spikes] == -1).all()
    assert (truth.patch[mixed] >= -1).all() and (truth.patch[mixed] >= 0).mean() > 0.9
    sizes = np.bincount(truth.patch[truth.patch >= 0])
    assert (np.diff(sizes) <= 0).all() and sizes.min() > 0


def test_mixed_points_lie_within_the_line_width_of_a_step() -> None:
    for name in ("surveyor-like", "modern", "harsh"):
        probe = scanner(name)
        scans, truth = scan_of_step(probe)
        assert truth.artefact is not None
        x = _world(scans)[:, 0]
        near = np.abs(x) < 1.5  # the outer ends of the part aside
        mixed = near & (truth.artefact == Artefact.MIXED)
        # The stage may be off by its backlash; the line is where it really stands.
        assert mixed.sum() > 20 and np.abs(x[mixed]).max() < probe.line_width / 2 + 0.03
        assert (np.abs(_world(scans)[near & ~mixed, 2] % 5.0 - 2.5) > 2.2).all()
    scans, truth = scan_of_step(scanner("ideal"))
    assert truth.artefact is None
    z = _world(scans)[:, 2]
    assert np.minimum(np.abs(z), np.abs(z - 5.0)).max() < 1e-9
    assert set(np.unique(_world(scans)[:, 0] > 0)) == {False, True}


def test_mirror_images_are_spikes_off_the_part_and_in_no_patch() -> None:
    # A polished face of 70 degrees beside a floor, too steep to be measured itself.
    tilt = np.radians(70.0)
    face = half_space((0, 0, 0), (-np.sin(tilt), 0.0, np.cos(tilt)))
    ramp = union(box((-12, -5, -2), (4, 5, 0)), intersection(face, box((-1, -5, -2), (4, 5, 8))))
    probe = _coarse("harsh", incidence_limit=np.radians(50.0), specular=0.4, views=(View(),))
    scans, truth = simulate(ramp, probe, seed=1)
    assert truth.artefact is not None and truth.surface is not None
    spikes = truth.artefact == Artefact.SPIKE
    assert spikes.sum() > 100
    assert (truth.patch[spikes] == -1).all() and len(np.unique(truth.surface[spikes])) == 1
    error, limit = _budget(probe, scans, truth)
    assert (np.abs(error[spikes]) > 0.5 * limit[spikes]).mean() > 0.9
    without, matte = simulate(ramp, dataclasses.replace(probe, specular=0.0), seed=1)
    assert matte.artefact is not None and not (matte.artefact == Artefact.SPIKE).any()
    assert len(without) < len(scans)


def test_the_recordings_are_still_what_the_default_scanner_measures() -> None:
    from octoseg_ti import files

    path = Path(__file__).resolve().parents[2] / "recordings" / "two-planes.mcap"
    recorded, (scans, truth) = files.read_truth(path), simulate(blocks.two_planes(), seed=7)
    assert recorded is not None and recorded.artefact is None
    for field in dataclasses.fields(Truth):
        if field.name != "info":
            found, expected = getattr(truth, field.name), getattr(recorded, field.name)
            assert (found is None) == (expected is None), field.name
            if found is not None:
                np.testing.assert_allclose(found, expected, atol=1e-5, err_msg=field.name)
    np.testing.assert_allclose(files.read(path).points, _world(scans), atol=1e-4)


def test_effects_that_are_off_leave_the_rest_as_it_is() -> None:
    # One effect more or less: every point that both scans have differs by that effect alone.
    full = _coarse("modern", specular=0.0, threshold=0.0, quantisation=0.0, saturation=None)
    scans, _ = simulate(_part(), full, seed=5)
    for name in ("speckle", "horizon", "encoder_jitter", "encoder_error", "backlash", "dropout"):
        less, _ = simulate(_part(), dataclasses.replace(full, **{name: 0.0}), seed=5)
        key = [s.stripe.astype(np.int64) * 10_000 + s.column for s in (scans, less)]
        _, i, j = np.intersect1d(*key, return_indices=True)
        assert len(i) > 0.97 * len(scans)
        change = np.linalg.norm(scans.points[i] - less.points[j], axis=1)
        if name == "dropout":
            assert len(less) > len(scans) and change.max() == 0.0
        else:
            # A tenth of the range noise: had it been drawn anew, it would differ by more.
            assert 0.0 < np.median(change) or name == "horizon"
            assert np.median(change) < 0.0015


def test_range_noise_of_a_scan_is_what_is_stated() -> None:
    plate = box((-10, -10, -1), (10, 10, 0))
    probe = StripeScanner(
        range_noise=0.02, incidence_noise=0.5, stripe_pitch=0.2, point_pitch=0.2, views=(View(),)
    )
    scans, truth = simulate(plate.turned("x", 0.9), probe)
    assert truth.normal is not None and truth.position is not None and scans.stripe is not None
    assert scans.stripe_origin is not None
    sight = truth.position - scans.stripe_origin[scans.stripe]
    cosine = -np.einsum("ij,ij->i", sight, truth.normal) / np.linalg.norm(sight, axis=1)
    error = np.linalg.norm(_world(scans) - truth.position, axis=1)
    level = np.abs(cosine - np.cos(0.9)) < 0.05
    assert np.sqrt((error[level] ** 2).mean()) == pytest.approx(
        0.02 * np.cos(0.9) ** -0.5, rel=0.05
    )


def test_threshold_and_counts() -> None:
    probe = _coarse("modern", dropout=0.0, specular=0.0)
    many = len(simulate(_part(), dataclasses.replace(probe, threshold=0.0))[0])
    few = len(simulate(_part(), dataclasses.replace(probe, threshold=0.7))[0])
    assert 0.2 * many < few < 0.8 * many
    exact, _ = simulate(_part(), scanner("surveyor-like", points=4000))
    assert len(exact) == 4000


def test_backlash_shifts_a_pass() -> None:
    plain = StripeScanner(
        range_noise=0.0, dropout=0.0, lost_ends=0.0, stripe_pitch=0.3, point_pitch=0.3,
        views=(View(),), encoder_jitter=1e-9,
    )  # fmt: skip
    late = dataclasses.replace(plain, backlash=0.1)
    scans, truth = simulate(sphere((0, 0, 0), 5.0), late)
    assert truth.position is not None and scans.T_world_view is not None
    shift = (_world(scans) - truth.position) @ scans.T_world_view[0, :3, 0]
    assert np.median(shift) == pytest.approx(0.1, abs=1e-6)


_RUN = """
import hashlib, sys
from octoseg_ti.device import runtime
runtime.start(threads=int(sys.argv[1]))
from scanner_sim import StripeScanner, box, simulate
probe = StripeScanner.preset("harsh", stripe_pitch=0.2, point_pitch=0.2)
part = box((-8, -6, 0), (8, 6, 5)) - box((-2, -7, 2), (3, 7, 6))
scans, truth = simulate(part, probe, seed=3)
arrays = [scans.points, scans.stripe, scans.column, truth.artefact, truth.position, truth.patch]
print(hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest())
"""


def test_same_seed_same_bytes_for_any_number_of_threads() -> None:
    runs = {
        subprocess.run([sys.executable, "-c", _RUN, n], check=True, capture_output=True, text=True)
        .stdout
        for n in ("1", "2")
    }  # fmt: skip
    assert len(runs) == 1 and len(runs.pop().strip()) == hashlib.sha256().digest_size * 2


def test_chunks_do_not_change_the_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    probe = _coarse("harsh")
    whole, _ = simulate(_part(), probe, seed=1)
    for module in ("line_kernel", "bounce", "passes"):
        monkeypatch.setattr(sys.modules[f"scanner_sim.{module}"], "_CHUNK", 500)
    monkeypatch.setattr(sys.modules["scanner_sim.effects"], "_BLOCK", 500)
    pieces, _ = simulate(_part(), probe, seed=1)
    np.testing.assert_array_equal(whole.points, pieces.points)


def test_presets() -> None:
    assert SCANNERS["default"] == StripeScanner() and not StripeScanner().effects
    assert not SCANNERS["ideal"].effects and set(LIMITS) == set(SCANNERS)
    assert set(SCANNERS["harsh"].effects) == set(EFFECTS)
    changed = StripeScanner.preset("modern", speckle=0.0)
    assert changed == dataclasses.replace(SCANNERS["modern"], speckle=0.0)
    assert "speckle" not in changed.effects
    with pytest.raises(DataError, match="no scanner 'old'"):
        StripeScanner.preset("old")
    with pytest.raises(DataError, match="no parameter 'colour'"):
        StripeScanner.preset("modern", colour=1)


@pytest.mark.parametrize(
    "values",
    [
        {"line_width": -0.1}, {"sub_rays": 8}, {"sub_rays": 27}, {"pixel": 0.0}, {"speckle": 1.5},
        {"specular": -0.1}, {"aperture": 1.0}, {"saturation": 0.0}, {"lobe": 0.0},
        {"backlash": float("nan")}, {"encoder_period": 0.0}, {"threshold": -1.0},
    ],
)  # fmt: skip
def test_impossible_effects_are_refused(values: dict[str, object]) -> None:
    with pytest.raises(DataError, match=f"StripeScanner: {next(iter(values))}"):
        StripeScanner(**values)  # type: ignore[arg-type]


def test_effects_are_recorded_in_the_truth() -> None:
    probe = _coarse("surveyor-like", stripe_pitch=1.0, point_pitch=1.0)
    info = simulate(_part(), probe)[1].info
    assert info["line_width"] == "0.15" and json.dumps(info)
    plain = simulate(_part(), StripeScanner(stripe_pitch=1.0))[1]
    assert plain.artefact is None and "line_width" not in plain.info
