"""STEP files written by OpenCASCADE: against CSG, against analytic surfaces, and errors."""

from __future__ import annotations

import builtins
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from octoseg_ti.errors import DataError, MissingPackageError
from octoseg_ti.types import EdgeClass, SurfaceKind
from scanner_sim import SolidOptions, StripeScanner, View, read_part, simulate
from scanner_sim.part import box, difference, rod
from scanner_sim.quadric import distance, gradient

pytest.importorskip("OCP.STEPControl")
from OCP.BRep import BRep_Builder
from OCP.BRepAlgoAPI import BRepAlgoAPI_Cut, BRepAlgoAPI_Fuse
from OCP.BRepBuilderAPI import BRepBuilderAPI_NurbsConvert, BRepBuilderAPI_Transform
from OCP.BRepFilletAPI import BRepFilletAPI_MakeFillet
from OCP.BRepPrimAPI import (
    BRepPrimAPI_MakeBox,
    BRepPrimAPI_MakeCone,
    BRepPrimAPI_MakeCylinder,
    BRepPrimAPI_MakeSphere,
    BRepPrimAPI_MakeTorus,
)
from OCP.gp import gp_Ax2, gp_Dir, gp_GTrsf, gp_Mat, gp_Pnt, gp_Trsf, gp_Vec
from OCP.STEPControl import STEPControl_StepModelType, STEPControl_Writer
from OCP.TopAbs import TopAbs_ShapeEnum
from OCP.TopExp import TopExp_Explorer
from OCP.TopLoc import TopLoc_Location
from OCP.TopoDS import TopoDS, TopoDS_Compound

_CLEAN: dict[str, float] = {"range_noise": 0.0, "dropout": 0.0, "lost_ends": 0.0}


def _write(path: Path, *shapes: Any) -> Path:
    writer = STEPControl_Writer()
    for shape in shapes:
        writer.Transfer(shape, STEPControl_StepModelType.STEPControl_AsIs)
    writer.Write(str(path))
    return path


def _block(x: float = 40.0, y: float = 30.0, z: float = 10.0) -> Any:
    return BRepPrimAPI_MakeBox(x, y, z).Solid()


def _bore(radius: float, angle: float = 2.0 * math.pi) -> Any:
    axis = gp_Ax2(gp_Pnt(20, 15, -1), gp_Dir(0, 0, 1))
    return BRepPrimAPI_MakeCylinder(axis, radius, 20.0, angle).Solid()


def _rounded(shape: Any, radius: float, *numbers: int) -> Any:
    maker, explorer, edges = (
        BRepFilletAPI_MakeFillet(shape), TopExp_Explorer(shape, TopAbs_ShapeEnum.TopAbs_EDGE), []
    )  # fmt: skip
    to_edge = getattr(TopoDS, "Edge", None) or TopoDS.Edge_s
    while explorer.More():
        edges.append(to_edge(explorer.Current()))
        explorer.Next()
    for number in numbers or range(len(edges)):
        maker.Add(radius, edges[number])
    return maker.Shape()


def _kinds(part: Any) -> dict[SurfaceKind, int]:
    kinds, counts = np.unique(part.surfaces.kind, return_counts=True)
    return {SurfaceKind(int(k)): int(c) for k, c in zip(kinds, counts, strict=True)}


def test_a_bored_block_scans_like_the_same_of_half_spaces(tmp_path: Path) -> None:
    solid = BRepAlgoAPI_Cut(_block(), _bore(6.0)).Shape()
    part = read_part(_write(tmp_path / "bored.step", solid))
    assert _kinds(part) == {SurfaceKind.PLANE: 6, SurfaceKind.CYLINDER: 1}
    assert part.info["open_edges"] == "0" and part.info["faces_off_their_surface"] == "0"
    scanner = StripeScanner(stripe_pitch=0.7, point_pitch=0.6, **_CLEAN)  # type: ignore[arg-type]
    scans, truth = simulate(part, scanner)
    csg = difference(box((0, 0, 0), (40, 30, 10)), rod((20, 15, -1), (20, 15, 19), 6.0))
    same, true = simulate(csg, scanner)
    assert scans.stripe is not None and same.stripe is not None
    assert scans.column is not None and same.column is not None
    keys = [10_000 * s.stripe + s.column for s in (scans, same)]
    a, b = np.intersect1d(*keys, return_indices=True)[1:]
    # All but points within the deflection of a shadow's border or of an edge.
    assert len(scans) > 6000 and len(a) > 0.999 * max(len(scans), len(same))
    assert truth.position is not None and true.position is not None
    assert truth.normal is not None and true.normal is not None
    off = np.linalg.norm(truth.position[a] - true.position[b], axis=1)
    assert np.quantile(off, 0.999) < 1e-9
    turned = np.linalg.norm(truth.normal[a] - true.normal[b], axis=1)
    assert np.quantile(turned, 0.999) < 1e-9
    assert truth.patch_count == true.patch_count == 6
    assert truth.edge_distance is not None and true.edge_distance is not None
    assert np.abs(truth.edge_distance[a] - true.edge_distance[b]).max() < 0.005
    assert (truth.kind[a] == true.kind[b]).mean() > 0.999  # type: ignore[index]


@pytest.mark.parametrize("name", ["ball", "cone", "ring", "pin"])
def test_points_lie_on_the_exact_surface(tmp_path: Path, name: str) -> None:
    axis = gp_Ax2(gp_Pnt(3, -2, 5), gp_Dir(1, 2, 5))
    shape, kind = {
        "ball": (BRepPrimAPI_MakeSphere(axis, 9.0), SurfaceKind.SPHERE),
        "cone": (BRepPrimAPI_MakeCone(axis, 3.0, 8.0, 9.0), SurfaceKind.CONE),
        "ring": (BRepPrimAPI_MakeTorus(axis, 9.0, 3.0), SurfaceKind.TORUS),
        "pin": (BRepPrimAPI_MakeCylinder(axis, 4.0, 12.0), SurfaceKind.CYLINDER),
    }[name]
    path = _write(tmp_path / "part.stp", shape.Shape())
    part = read_part(path, SolidOptions(deflection=0.05))
    scanner = StripeScanner(points=3000, range_noise=0.0)
    _, truth = simulate(part, scanner)
    assert kind in truth.kind  # type: ignore[operator]
    assert truth.position is not None and truth.surface is not None and truth.normal is not None
    gap = np.abs(distance(part.surfaces, truth.surface, truth.position))
    assert gap.max() < 1e-9
    slope = np.abs((gradient(part.surfaces, truth.surface, truth.position) * truth.normal).sum(1))
    np.testing.assert_allclose(slope, 1.0, atol=1e-12)
    # Nothing is lost to triangles that lie above a hollow or below a bulge.
    finer = simulate(read_part(path, SolidOptions(deflection=0.01)), scanner)[1]
    assert truth.patch_count == finer.patch_count


def test_halves_of_a_cylinder_and_pieces_of_a_plane_are_one_surface(tmp_path: Path) -> None:
    half = _bore(6.0, math.pi)
    move = gp_Trsf()
    move.SetRotation(gp_Ax2(gp_Pnt(20, 15, 0), gp_Dir(0, 0, 1)).Axis(), math.pi)
    other = BRepBuilderAPI_Transform(half, move).Shape()
    solid = BRepAlgoAPI_Cut(BRepAlgoAPI_Cut(_block(), half).Shape(), other).Shape()
    shift = gp_Trsf()
    shift.SetTranslation(gp_Vec(40, 0, 0))
    twice = BRepAlgoAPI_Fuse(solid, BRepBuilderAPI_Transform(_block(10), shift).Shape()).Shape()
    part = read_part(_write(tmp_path / "halves.step", twice))
    assert int(part.info["brep_faces"]) > len(part.surfaces.kind) == 7
    assert _kinds(part)[SurfaceKind.CYLINDER] == 1
    _, truth = simulate(part, StripeScanner(points=12_000))
    assert truth.patch_count == 6
    # No edge runs down the seam of the bore, nor over the top where the blocks meet.
    middle = 0.5 * (part.edges.start + part.edges.end)
    assert not ((np.abs(middle[:, 0] - 40) < 1e-6) & (middle[:, 2] > 9.99)
                & (middle[:, 1] > 0.01) & (middle[:, 1] < 29.99)).any()  # fmt: skip
    on_bore = np.abs(np.hypot(middle[:, 0] - 20, middle[:, 1] - 15) - 6) < 0.01
    assert (np.abs(middle[on_bore, 2] - 5) > 4.99).all()


def test_small_rounds_are_fillets_and_large_ones_are_not(tmp_path: Path) -> None:
    path = _write(tmp_path / "round.step", _rounded(_block(), 1.0))
    part = read_part(path)  # the limit is 1/40 of 51 mm
    fillet = part.surfaces.fillet
    assert _kinds(part) == {SurfaceKind.PLANE: 6, SurfaceKind.CYLINDER: 12, SurfaceKind.SPHERE: 8}
    assert fillet.sum() == 20 and not fillet[part.surfaces.kind == SurfaceKind.PLANE].any()
    assert set(part.edges.kind) == {EdgeClass.FILLET}
    _, truth = simulate(part, StripeScanner(points=9000))
    assert truth.patch_count == 5 and truth.surface is not None
    on = fillet[truth.surface]
    assert 300 < on.sum() and (truth.patch[on] == -1).all()
    assert truth.edge_class is not None and truth.edge_distance is not None
    assert (truth.edge_class[on] == EdgeClass.FILLET).all() and (truth.edge_distance[on] == 0).all()
    for options in (SolidOptions(fillet_radius=0.9), SolidOptions(fillet_radius=0.0)):
        bare = read_part(path, options)
        assert not bare.surfaces.fillet.any()
        assert set(bare.edges.kind) == {EdgeClass.SMOOTH}
    assert read_part(path, SolidOptions(fillet_radius=1.0)).surfaces.fillet.sum() == 20


def test_thin_pins_and_narrow_bores_are_no_fillets(tmp_path: Path) -> None:
    part = read_part(_write(tmp_path / "bore.step", BRepAlgoAPI_Cut(_block(), _bore(0.8)).Shape()))
    assert not part.surfaces.fillet.any()
    pin = BRepPrimAPI_MakeCylinder(gp_Ax2(gp_Pnt(0, 0, 0), gp_Dir(0, 0, 1)), 1.0, 60.0).Solid()
    part = read_part(_write(tmp_path / "pin.step", _rounded(pin, 0.4)))
    kinds = part.surfaces.kind
    assert part.surfaces.fillet[kinds == SurfaceKind.TORUS].all()
    assert not part.surfaces.fillet[kinds == SurfaceKind.CYLINDER].any()


def test_free_form_faces_are_met_within_the_error_that_is_stated(tmp_path: Path) -> None:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_GTransform

    stretch = gp_GTrsf(gp_Mat(1, 0, 0, 0, 1.5, 0, 0, 0, 0.6), gp_Pnt(0, 0, 0).XYZ())
    egg = BRepBuilderAPI_GTransform(BRepPrimAPI_MakeSphere(8.0).Solid(), stretch, True).Shape()
    part = read_part(_write(tmp_path / "egg.step", egg), SolidOptions(deflection=0.01))
    assert set(_kinds(part)) == {SurfaceKind.FREE_FORM}
    _, truth = simulate(part, StripeScanner(points=6000, range_noise=0.0))
    assert truth.patch_count == 1
    assert truth.position is not None and truth.normal is not None
    q = truth.position / [8.0, 12.0, 4.8]
    slope = 2.0 * q / [8.0, 12.0, 4.8]
    length = np.linalg.norm(slope, axis=1)
    gap = np.abs((q**2).sum(axis=1) - 1.0) / length
    # As good as was stated when the file was read, and far better than the triangles.
    assert gap.max() < 2.0 * float(part.info["free_form_error_mm"]) < 0.0002
    assert gap.max() < 0.02 * part.deflection
    cosine = (slope / length[:, None] * truth.normal).sum(axis=1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.3


def test_planes_written_as_splines_are_planes(tmp_path: Path) -> None:
    splines = BRepBuilderAPI_NurbsConvert(BRepAlgoAPI_Cut(_block(), _bore(6.0)).Shape(), True)
    part = read_part(_write(tmp_path / "nurbs.step", splines.Shape()))
    assert _kinds(part) == {SurfaceKind.PLANE: 6, SurfaceKind.CYLINDER: 1}


def test_several_solids_are_one_part(tmp_path: Path) -> None:
    shift = gp_Trsf()
    shift.SetTranslation(gp_Vec(60, 0, 0))
    builder, pair = BRep_Builder(), TopoDS_Compound()
    builder.MakeCompound(pair)
    builder.Add(pair, _block())
    builder.Add(pair, _block().Moved(TopLoc_Location(shift)))
    part = read_part(_write(tmp_path / "pair.step", pair))
    assert part.info["solids"] == "2"
    np.testing.assert_allclose(part.box, [[0, 0, 0], [100, 30, 10]], atol=1e-9)
    _, truth = simulate(part, StripeScanner(points=6000, views=(View(),)))
    assert truth.patch_count == 2 and truth.surface is not None
    assert len(np.unique(truth.surface)) == 1  # both tops are one plane


def test_the_unit_of_the_file_is_honoured(tmp_path: Path) -> None:
    from OCP.Interface import Interface_Static

    before = Interface_Static.CVal_s("write.step.unit")
    try:
        Interface_Static.SetCVal_s("write.step.unit", "INCH")
        path = _write(tmp_path / "inch.step", _block())
    finally:
        Interface_Static.SetCVal_s("write.step.unit", before)
    text = path.read_text()
    assert "INCH" in text.upper() and "1.5748" in text  # 40 mm
    np.testing.assert_allclose(read_part(path).box[1], [40, 30, 10], atol=1e-9)


def test_what_is_no_step_file_is_refused(tmp_path: Path, capfd: Any) -> None:
    whole = _write(tmp_path / "whole.step", _block()).read_bytes()
    capfd.readouterr()
    for name, content, wanted in (
        ("text.step", b"this is no STEP file\n" * 9, "not a STEP file"),
        ("empty.step", b"", "empty"),
        ("cut.step", whole[: len(whole) // 3], "STEP file"),
        ("head.step", whole[:300], "STEP file"),
        ("junk.stp", b"ISO-10303-21;\nDATA;\n#1=JUNK(;\nENDSEC;\nEND-ISO-10303-21;\n", "STEP file"),
    ):  # fmt: skip
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(DataError, match=wanted) as caught:
            read_part(path)
        assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)
    read_part(tmp_path / "whole.step")
    assert capfd.readouterr() == ("", "")  # OpenCASCADE keeps its remarks to itself


def test_a_step_file_of_curves_has_no_faces(tmp_path: Path) -> None:
    from OCP.BRepBuilderAPI import BRepBuilderAPI_MakeEdge

    edge = BRepBuilderAPI_MakeEdge(gp_Pnt(0, 0, 0), gp_Pnt(1, 1, 1)).Edge()
    with pytest.raises(DataError, match="no faces"):
        read_part(_write(tmp_path / "line.step", edge))


def test_without_opencascade_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = _write(tmp_path / "block.step", _block())
    real = builtins.__import__

    def without(name: str, *rest: Any) -> Any:
        if name.split(".")[0] == "OCP":
            raise ImportError(name)
        return real(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingPackageError, match=r"pip install 'octoseg\[cad\]'"):
        read_part(path)
