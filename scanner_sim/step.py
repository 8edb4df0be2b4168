"""STEP files as parts, by OpenCASCADE (the extra ``cad``).

OpenCASCADE reads the file, in mm whatever its unit, and lays triangles over every face. What a face
is (plane, cylinder, cone, sphere, torus) is asked of it as well, so that rays end on the surface
itself; faces of one surface are one surface of the truth, and small ones that join their neighbours
smoothly are fillets.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from octoseg_ti.errors import DataError, MissingPackageError
from octoseg_ti.types import SurfaceKind
from scanner_sim.brep import Faces, brep_part
from scanner_sim.mesh import MeshPart, no_form

_DEFLECTION = (5e-5, 2e-5)
"""Default deflection, relative to the diagonal of the box: where every face has an exact form, and
where rays end on the triangles of free-form faces."""
_EXACT = 1e-6  # a free-form surface this close to a quadric is one, relative to the part


class _Form(NamedTuple):
    """What one face is."""

    kind: SurfaceKind
    row: np.ndarray
    """point (3), axis (3), a, b; NaN for free-form, shape (8,)."""


def read_step(
    path: Path,
    *,
    deflection: float | None = None,
    angular: float = 0.1,
    fillet_radius: float | None = None,
) -> MeshPart:
    """Read all faces of a STEP file.

    Args:
        path: The file.
        deflection: Distance of the triangles from the surfaces [mm]; None = 1/50,000 of the
            diagonal of the box, or 1/20,000 when no face is free-form.
        angular: Angle between neighbouring triangles [rad].
        fillet_radius: See `SolidOptions`.

    Raises:
        DataError: It is no STEP file, or has no faces.
        MissingPackageError: OpenCASCADE is not installed.
    """
    try:
        from OCP.BRepMesh import BRepMesh_IncrementalMesh
    except ImportError as error:
        raise MissingPackageError("cadquery-ocp-novtk", "cad", "reading STEP") from error
    shape = _shape(path)
    faces = _faces(shape)
    if not faces:
        hint = "a file with solids or surfaces is wanted"
        raise DataError("the STEP file has no faces", path=path, hint=hint)
    size = _size(shape)
    looks = [_form(face, _EXACT * size) for face in faces]
    if deflection is None:
        deflection = _DEFLECTION[any(f.kind == SurfaceKind.FREE_FORM for f in looks)] * size
    BRepMesh_IncrementalMesh(shape, deflection, False, angular, True)
    corners, normals, face, bare = [], [], [], 0
    forms: list[_Form] = []
    for each, form in zip(faces, looks, strict=True):
        triangles = _triangles(each, form.kind == SurfaceKind.FREE_FORM)
        bare += triangles is None
        if triangles is not None:
            corners.append(triangles[0])
            normals.append(triangles[1])
            face.append(np.full(len(triangles[0]), len(forms)))
            forms.append(form)
    if not forms:
        raise DataError("none of the faces of the STEP file can be tessellated", path=path)
    part = brep_part(
        Faces(
            corners=np.concatenate(corners), normals=np.concatenate(normals),
            face=np.concatenate(face), kind=np.array([f.kind for f in forms], np.int32),
            data=np.stack([f.row for f in forms]),
        ),
        deflection=deflection, fillet_radius=fillet_radius, name=path.name, path=path,
    )  # fmt: skip
    counts = {"format": "step", "solids": str(_solids(shape)), "faces_without_triangles": str(bare)}
    part.info.update(counts)
    return part


def _shape(path: Path) -> Any:
    """Return everything in the file as one shape."""
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.Message import Message, Message_Gravity
    from OCP.STEPControl import STEPControl_Reader

    with path.open("rb") as stream:
        if b"ISO-10303-21" not in stream.read(4096):
            raise DataError("not a STEP file", path=path, hint="it begins with ISO-10303-21")
    for printer in Message.DefaultMessenger_s().Printers():  # its remarks are not our output
        printer.SetTraceLevel(Message_Gravity.Message_Fail)
    reader = STEPControl_Reader()
    if reader.ReadFile(str(path)) != IFSelect_RetDone:
        raise DataError("not a readable STEP file", path=path, hint="write or fetch it again")
    reader.TransferRoots()
    shape = reader.OneShape()
    if shape is None or shape.IsNull():
        raise DataError("the STEP file has no shape", path=path, hint="is it cut off?")
    return shape


def _each(shape: Any, what: Any) -> list[Any]:
    """Return the shapes of one type within a shape, each once."""
    from OCP.TopExp import TopExp_Explorer

    explorer = TopExp_Explorer(shape, what)
    found: dict[int, list[Any]] = {}
    while explorer.More():
        current = explorer.Current()
        same = found.setdefault(hash(current), [])
        if not any(current.IsSame(other) for other in same):
            same.append(current)
        explorer.Next()
    return [shape for same in found.values() for shape in same]


def _faces(shape: Any) -> list[Any]:
    """Return the faces of a shape."""
    from OCP.TopAbs import TopAbs_ShapeEnum
    from OCP.TopoDS import TopoDS

    to_face = getattr(TopoDS, "Face", None) or TopoDS.Face_s  # OpenCASCADE 8, and before
    return [to_face(face) for face in _each(shape, TopAbs_ShapeEnum.TopAbs_FACE)]


def _solids(shape: Any) -> int:
    """Return the number of solids of a shape."""
    from OCP.TopAbs import TopAbs_ShapeEnum

    return len(_each(shape, TopAbs_ShapeEnum.TopAbs_SOLID))


def _size(shape: Any) -> float:
    """Return the length of the diagonal of the box around a shape [mm]."""
    from OCP.Bnd import Bnd_Box
    from OCP.BRepBndLib import BRepBndLib

    box = Bnd_Box()
    BRepBndLib.Add_s(shape, box, False)
    return float(np.sqrt(box.SquareExtent()))


def _triangles(face: Any, free: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Return corners [mm] and normals of the triangles of a face, shapes (T, 3, 3); None without.

    The normals are those of the surface itself where it is free-form, else 0.
    """
    from OCP.BRep import BRep_Tool
    from OCP.TopAbs import TopAbs_Orientation
    from OCP.TopLoc import TopLoc_Location

    where = TopLoc_Location()
    mesh = BRep_Tool.Triangulation_s(face, where)
    if mesh is None or mesh.NbTriangles() == 0:
        return None
    nodes = np.array([mesh.Node(i).Coord() for i in range(1, mesh.NbNodes() + 1)])
    if not where.IsIdentity():
        move = where.Transformation()
        matrix = np.array([[move.Value(i, j) for j in range(1, 5)] for i in range(1, 4)])
        nodes = nodes @ matrix[:, :3].T + matrix[:, 3]
    triangles = np.array([mesh.Triangle(i).Get() for i in range(1, mesh.NbTriangles() + 1)]) - 1
    if face.Orientation() == TopAbs_Orientation.TopAbs_REVERSED:
        triangles = triangles[:, ::-1]
    normals = _normals(face, mesh) if free else np.zeros((len(nodes), 3))
    return nodes[triangles], normals[triangles]


def _normals(face: Any, mesh: Any) -> np.ndarray:
    """Return the normal of the surface at every node; 0 where it has none; either sign."""
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.gp import gp_Pnt, gp_Vec

    surface = BRepAdaptor_Surface(face)
    point, along_u, along_v = gp_Pnt(), gp_Vec(), gp_Vec()
    rows = np.zeros((mesh.NbNodes(), 2, 3))
    for i in range(mesh.NbNodes() if mesh.HasUVNodes() else 0):
        u, v = mesh.UVNode(i + 1).Coord()
        surface.D1(u, v, point, along_u, along_v)
        rows[i] = along_u.Coord(), along_v.Coord()
    normals = np.cross(rows[:, 0], rows[:, 1])
    length: np.ndarray = np.linalg.norm(normals, axis=1, keepdims=True)
    scale = np.linalg.norm(rows, axis=2).max(initial=0.0) ** 2
    return np.where(length > 1e-9 * scale, normals / np.maximum(length, 1e-300), 0.0)


def _form(face: Any, tolerance: float) -> _Form:
    """Return what a face is."""
    from OCP.BRepAdaptor import BRepAdaptor_Surface

    surface = BRepAdaptor_Surface(face)
    name = surface.GetType().name.removeprefix("GeomAbs_")
    if name in ("Plane", "Cylinder", "Cone", "Sphere", "Torus"):
        return _row(name, getattr(surface, name)())
    return _recognised(face, tolerance) or _Form(SurfaceKind.FREE_FORM, no_form(1)[0])


def _recognised(face: Any, tolerance: float) -> _Form | None:
    """Return what a free-form face is in truth: exporters often write planes as splines."""
    from OCP.gp import gp_Cone, gp_Cylinder, gp_Pln, gp_Sphere
    from OCP.ShapeAnalysis import ShapeAnalysis_CanonicalRecognition

    look = ShapeAnalysis_CanonicalRecognition(face)
    for name, form, fits in (
        ("Plane", gp_Pln(), look.IsPlane), ("Cylinder", gp_Cylinder(), look.IsCylinder),
        ("Cone", gp_Cone(), look.IsCone), ("Sphere", gp_Sphere(), look.IsSphere),
    ):  # fmt: skip
        if fits(tolerance, form):
            return _row(name, form)
    return None


def _row(name: str, form: Any) -> _Form:
    """Return kind and data of an elementary surface."""
    kind, a, b = SurfaceKind[name.upper()], 0.0, 0.0
    point = form.Apex() if name == "Cone" else form.Location()
    axis = form.Position().Direction()
    turn = 1.0
    if name in ("Cylinder", "Sphere"):
        a = form.Radius()
    elif name == "Torus":
        a, b = form.MajorRadius(), form.MinorRadius()
    elif name == "Cone":
        a, turn = abs(form.SemiAngle()), 1.0 if form.SemiAngle() > 0.0 else -1.0
    along = [turn * c for c in axis.Coord()]
    return _Form(kind, np.array([*point.Coord(), *along, a, b], float))
