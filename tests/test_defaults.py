"""What is left open is derived from the measurement; what is given stays."""

import math
from dataclasses import replace

import pytest

from octoseg_ti.defaults import derive
from octoseg_ti.params import (
    CleaningParams,
    GridParams,
    NormalParams,
    Params,
    RegionParams,
    RegistrationParams,
    SurfaceParams,
)
from octoseg_ti.types import Measurement

CLEAN = Measurement(spacing_along=0.2, spacing_across=0.5, noise=0.001, normal_noise=0.004)


def test_every_open_value_is_filled_in() -> None:
    filled = derive(Params(), CLEAN).to_dict()
    still_open = [
        f"{section}.{key}"
        for section, values in filled.items()
        for key, value in values.items()
        if value is None
    ]
    assert still_open == ["grid.divisions"]  # open means: from the smallest cell


def test_lengths_follow_the_larger_spacing() -> None:
    small = derive(Params(), CLEAN)
    large = derive(Params(), replace(CLEAN, spacing_along=2.0, spacing_across=5.0, noise=0.01))
    assert small.grid.min_cell == pytest.approx(1.8 * 0.5)
    for section, key in (
        ("cleaning", "spike"), ("cleaning", "isolation"), ("normals", "gap"), ("grid", "min_cell"),
    ):  # fmt: skip
        one, other = (getattr(getattr(p, section), key) for p in (small, large))
        assert other == pytest.approx(10 * one), f"{section}.{key} is a length"
    assert large.grid.tolerance == small.grid.tolerance
    assert large.regions.min_points == small.regions.min_points


def test_noise_raises_the_tolerance_and_the_spike() -> None:
    tolerances, spikes = [], []
    for factor in (1.0, 10.0, 50.0, 1000.0):
        noisy = replace(CLEAN, noise=0.1 * factor, normal_noise=0.004 * factor)
        params = derive(Params(), noisy)
        tolerances.append(params.grid.tolerance)
        spikes.append(params.cleaning.spike)
        assert params.grid.tolerance >= min(1.0, 2 * noisy.normal_noise)
        assert params.grid.edge_tolerance >= params.grid.tolerance
        assert 0.1 <= params.regions.homogeneity <= 0.35
        assert params.cleaning.spike >= 4 * noisy.noise
    assert tolerances == sorted(tolerances) and spikes == sorted(spikes)
    assert tolerances[-1] == 1.0  # sigma is never above


def test_given_values_stay() -> None:
    given = Params(
        cleaning=CleaningParams(spike=0.7, isolation=8.0, detached=9),
        normals=NormalParams(gap=0.9, weight="area", smooth=4),
        registration=RegistrationParams(reach=2.5),
        grid=GridParams(tolerance=0.2, edge_tolerance=0.25, min_cell=3.0, divisions=7),
        regions=RegionParams(homogeneity=0.5, min_points=11),
        surfaces=SurfaceParams(noise=0.1, tilt=0.2, turn=0.4, min_points=20),
    )
    assert derive(given, CLEAN) == given


def test_a_patch_is_a_square_of_cells() -> None:
    """16 smallest cells, in points of the given spacings."""
    area = 16 * (1.8 * 0.5) ** 2
    assert derive(Params(), CLEAN).regions.min_points == round(area / (0.2 * 0.5))


def test_views_that_are_apart_prove_no_narrow_faces() -> None:
    few = derive(Params(), CLEAN)
    assert few.surfaces.min_points is not None and few.regions.min_points is not None
    assert few.surfaces.min_points < few.regions.min_points
    apart = derive(Params(), replace(CLEAN, view_noise=2.0 * CLEAN.noise))
    assert apart.surfaces.min_points == apart.regions.min_points == few.regions.min_points


def test_nothing_measured_gives_finite_values() -> None:
    nothing = Measurement(spacing_along=0.0, spacing_across=0.0, noise=0.0, normal_noise=0.0)
    params = derive(Params(), nothing)
    assert params.regions.min_points >= 3
    assert params.grid.tolerance is not None and math.isfinite(params.grid.tolerance)


def test_deriving_twice_is_deriving_once() -> None:
    once = derive(Params(), CLEAN)
    assert derive(once, replace(CLEAN, noise=1.0, spacing_across=9.0)) == once
