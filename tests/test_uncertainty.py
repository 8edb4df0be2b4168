"""The covariances of a result tell how far its surfaces are from the true ones."""

from dataclasses import replace

import numpy as np
import pytest
from reference.covariances import UNKNOWNS, nearest_form, squared_error
from reference.surfaces import CYLINDER, PLANE, SPHERE

from octoseg_ti import Scans, Segmentation, Truth, paper, segment
from octoseg_ti.fitting.primitives import fit_all
from octoseg_ti.stages.sets import spread


@pytest.fixture(scope="module")
def scanned() -> list[tuple[Scans, Truth]]:
    """The test block in four small scans, with independent noise and true poses."""
    from scanner_sim import StripeScanner, blocks, simulate

    scanner = StripeScanner(points=20_000, range_noise=0.01)
    return [simulate(blocks.test_block(), scanner, seed=seed) for seed in range(4)]


def true_surfaces(result: Segmentation, truth: Truth) -> dict[int, np.ndarray]:
    """Return the true parameters of every patch of the right kind: fitted to the true points."""
    assert truth.surface is not None and truth.kind is not None
    assert truth.position is not None and truth.normal is not None
    found = {}
    for k in range(result.patch_count):
        names = truth.surface[result.labels == k]
        name = int(np.argmax(np.bincount(names[names >= 0])))
        on = spread(np.flatnonzero(truth.surface == name), 500)
        kind = int(truth.kind[on[0]])
        if kind != result.kind[k]:
            continue
        start = np.array([0, len(on)], np.int32)
        fits = fit_all(truth.position[on], truth.normal[on], None, start)
        assert fits.rms[0, kind] < 1e-6
        found[k] = fits.parameters[0, kind]
    return found


def test_errors_are_as_large_as_they_say(scanned) -> None:
    errors: dict[int, list[float]] = {PLANE: [], CYLINDER: [], SPHERE: []}
    for scans, truth in scanned:
        result = segment(scans)
        for k, true in true_surfaces(result, truth).items():
            kind = int(result.kind[k])
            found, covariance = result.parameters[k], result.covariance[k]
            square = squared_error(kind, found, true, covariance)
            errors[kind].append(square / UNKNOWNS[kind])
            if kind == PLANE:
                normal = found[3:6]
                off = (found[:3] - nearest_form(kind, true, found)[:3]) @ normal
                assert abs(off) < 4.0 * np.sqrt(normal @ covariance[:3, :3] @ normal)
            else:
                assert abs(found[6] - true[6]) < 4.0 * result.deviation[k, 6]
    assert len(errors[PLANE]) >= 24 and len(errors[CYLINDER]) >= 6
    for kind, squares in errors.items():
        assert np.mean(squares) < 2.0, kind
    assert 0.5 < np.mean(errors[PLANE]) < 1.7


def test_patches_of_one_surface_share_a_covariance(scanned) -> None:
    result = segment(scanned[0][0])
    for k, name in enumerate(result.surface):
        first = np.flatnonzero(result.surface == name)[0]
        np.testing.assert_array_equal(result.covariance[k], result.covariance[first])


def test_where_the_part_lies_makes_no_difference(scanned) -> None:
    scans, _ = scanned[0]
    assert scans.T_world_view is not None and scans.origin is not None
    shift = np.array([512.0, -1024.0, 256.0])
    poses = scans.T_world_view.copy()
    poses[:, :3, 3] += shift
    moved = replace(scans, T_world_view=poses, origin=scans.origin + shift, stripe_origin=None)
    here, there = segment(replace(scans, stripe_origin=None)), segment(moved)
    assert np.array_equal(here.kind, there.kind)
    np.testing.assert_allclose(there.parameters[:, :3] - shift, here.parameters[:, :3], atol=1e-4)
    np.testing.assert_allclose(there.deviation, here.deviation, rtol=1e-2, atol=1e-7)


def test_planes_found_without_surfaces_have_one_too(scanned) -> None:
    result = segment(scanned[0][0], paper())
    planes = np.flatnonzero(result.kind == PLANE)
    assert len(planes) > 3
    for k in planes:
        assert np.isfinite(result.covariance[k, :6, :6]).all()
        n = result.parameters[k, 3:6]
        deviation = np.sqrt(n @ result.covariance[k, :3, :3] @ n)
        expected = result.residual[k] / np.sqrt(result.patch_sizes[k])
        assert deviation == pytest.approx(expected, rel=0.5)
