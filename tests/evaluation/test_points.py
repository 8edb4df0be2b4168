"""Scores of single points: normals, edges, artefacts, and the radii of fillets."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from octoseg_ti import DataError, Truth, evaluate
from octoseg_ti.types import Fillets

from .cases import edge_case, five


def tilted(normals, angle):
    """Return the normals turned by an angle [rad] about some axis across each."""
    across = np.cross(normals, [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    return np.cos(angle)[:, None] * normals + np.sin(angle)[:, None] * across


def test_normal_error_of_known_angles():
    rng = np.random.default_rng(5)
    true = rng.normal(size=(1001, 3))
    true /= np.linalg.norm(true, axis=1, keepdims=True)
    angle = np.radians(np.linspace(0, 10, 1001))
    labels = np.zeros(1001, int)
    result = SimpleNamespace(labels=labels, normals=-3 * tilted(true, angle))
    n = evaluate(result, Truth(patch=labels, normal=true)).normals
    assert math.degrees(n.median) == pytest.approx(5, abs=1e-9)
    assert math.degrees(n.p95) == pytest.approx(9.5, abs=1e-9)
    assert (n.missing, n.points) == (0.0, 1001)
    result.normals[:100], result.normals[100] = 0, np.nan
    true[-1] = np.nan
    scores = evaluate(result, Truth(patch=labels, normal=true))
    assert scores.normals.points == 1000
    assert scores.normals.missing == pytest.approx(0.101)
    assert scores.to_dict()["normals"]["p95_deg"] == pytest.approx(90)


def test_edge_scores_of_a_known_row():
    result, truth = edge_case()
    scores = evaluate(result, truth, edge_distance=1.0)
    e = scores.edges
    assert (e["sharp"].precision, e["sharp"].recall) == (0.5, 1.0)
    assert e["sharp"].f1 == pytest.approx(2 / 3)
    assert (e["fillet"].precision, e["fillet"].recall) == (1.0, 0.6)
    assert (e["all"].found, e["all"].true) == (7, 7)
    assert e["all"].precision == pytest.approx(5 / 7)
    # 0-3, 6-12, 18, 19 are interior: patch 0 keeps 3 of 4 points, patch 1 8 of 9.
    assert scores.regions_interior.points == 13
    assert five(result.labels, truth.patch, 0.6) == (2, 0, 0, 0, 0)
    assert scores.regions_interior.correct == 1
    assert scores.regions_interior.labelled == pytest.approx(11 / 13)


def test_artefact_scores_of_a_known_row():
    artefact = np.array([0, 0, 0, 0, 1, 1, 1, 2, 2, 3], np.uint8)
    outlier = np.array([0, 0, 0, 1, 1, 0, 0, 1, 1, 0], np.uint8)
    labels = np.zeros(10, int)
    truth = Truth(patch=labels, artefact=artefact)
    a = evaluate(SimpleNamespace(labels=labels, outlier=outlier), truth).artefacts
    assert (a.found, a.true, a.precision, a.recall) == (4, 6, 0.75, 0.5)
    assert a.f1 == pytest.approx(0.6)
    assert a.classes == {"mixed": (3, 1 / 3), "spike": (2, 1.0), "multi-bounce": (1, 0.0)}
    scores = evaluate(SimpleNamespace(labels=labels, outlier=0 * outlier), truth)
    values = scores.to_dict()["artefacts"]
    assert values["precision"] is None and values["recall"] == 0.0
    assert values["classes"]["spike"] == {"true": 2, "recall": 0.0}
    assert "spike, 2 points" in str(scores)
    for other in (SimpleNamespace(labels=labels), labels):
        assert evaluate(other, truth).artefacts is None
    assert evaluate(SimpleNamespace(labels=labels, outlier=outlier), labels).artefacts is None
    with pytest.raises(DataError, match="artefacts"):
        evaluate(labels, Truth(patch=labels, artefact=artefact[:3]))


def test_default_edge_distance():
    result, truth = edge_case()
    scores = evaluate(result, truth)
    assert (scores.edge_distance, scores.edge_distance_from) == (2.0, "2 x nearest neighbours")
    result.measured = SimpleNamespace(spacing_along=0.2, spacing_across=0.5)
    scores = evaluate(result, truth)
    assert (scores.edge_distance, scores.edge_distance_from) == (1.0, "2 x measured spacing")
    bare = evaluate(result.labels, truth)
    assert bare.edge_distance is None
    assert bare.regions_interior is None
    assert "give the edge distance" in bare.edge_distance_from
    with pytest.raises(ValueError, match="nothing tells"):
        bare.sweep(interior=True)


def test_radii_of_fillets() -> None:
    """Of three fillets one is off by a tenth, and one lies on no true fillet."""
    point = np.repeat([0, 1, 2, -1], [60, 30, 10, 20]).astype(np.int32)
    radius = np.where(point == 2, np.nan, 2.0).astype(np.float32)
    truth = Truth(patch=np.zeros(120, np.int32), radius=radius)
    three = np.zeros(3)
    found = Fillets(
        patches=np.zeros((3, 2), np.int32), radius=np.array([2.02, 1.8, 5.0]), deviation=three,
        concave=three.astype(np.uint8), points=np.array([60, 30, 10], np.int32),
        strip=np.full(1, -1, np.int32), point=point,
    )  # fmt: skip
    scores = evaluate(SimpleNamespace(labels=truth.patch, fillets=found), truth)
    got = scores.fillets
    assert got is not None and (got.found, got.right) == (3, 2)
    np.testing.assert_allclose(
        [got.median, got.worst, got.within_5, got.within_10], [0.055, 0.1, 2 / 3, 1.0]
    )
    assert "fillets: 3 found, 2 right" in str(scores)
    assert evaluate(SimpleNamespace(labels=truth.patch, fillets=found), truth.patch).fillets is None
