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
from scanner_sim.curved import mixed, patch_points, shares
from scanner_sim.mesh import MeshPart, no_form

_DEFLECTION = 5e-5  # default, relative to the diagonal of the box
_ERROR = 1e-5  # free-form faces are laid out finer until the truth is this good, relative as well
_FINER = 3
_CHECKED = 3000  # triangles of a face at which the truth is compared with the face
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
        deflection: Distance of the triangles from the surfaces [mm]; None = 1/20,000 of the
            diagonal of the box, or less where free-form faces need it.
        angular: Angle between neighbouring triangles [rad].
        fillet_radius: See `SolidOptions`.

    Raises:
        DataError: It is no STEP file, or has no faces.
        MissingPackageError: OpenCASCADE is not installed.
    """
    try:
        import OCP.STEPControl  # noqa: F401
    except ImportError as error:
        raise MissingPackageError("cadquery-ocp-novtk", "cad", "reading STEP") from error
    shape = _shape(path)
    faces = _faces(shape)
    if not faces:
        hint = "a file with solids or surfaces is wanted"
        raise DataError("the STEP file has no faces", path=path, hint=hint)
    size = _size(shape)
    forms = [_form(face, _EXACT * size) for face in faces]
    step = _DEFLECTION * size if deflection is None else deflection
    for left in reversed(range(_FINER)):
        sheets = _lay_out(shape, faces, forms, step, angular)
        worst = max((s.error for s in sheets if s is not None), default=0.0)
        if deflection is not None or worst <= _ERROR * size or left == 0:
            break
        step /= 4.0
    found = [(form, sheet) for form, sheet in zip(forms, sheets, strict=True) if sheet is not None]
    if not found:
        raise DataError("none of the faces of the STEP file can be tessellated", path=path)
    part = brep_part(
        Faces(
            corners=np.concatenate([sheet.corners for _, sheet in found]),
            normals=np.concatenate([sheet.normals for _, sheet in found]),
            face=np.repeat(np.arange(len(found)), [len(sheet.corners) for _, sheet in found]),
            kind=np.array([form.kind for form, _ in found], np.int32),
            data=np.stack([form.row for form, _ in found]),
        ),
        deflection=step, fillet_radius=fillet_radius, name=path.name, path=path,
    )  # fmt: skip
    part.info.update(
        format="step", solids=str(_solids(shape)), free_form_error_mm=f"{worst:.2g}",
        faces_without_triangles=str(len(faces) - len(found)),
    )  # fmt: skip
    return part


class _Sheet(NamedTuple):
    """The triangles of one face."""

    corners: np.ndarray
    """Corners [mm], anticlockwise seen from outside, shape (T, 3, 3)."""
    normals: np.ndarray
    """Normals of a free-form surface there, of either sign; else 0, shape (T, 3, 3)."""
    error: float
    """Distance of the curved patches from a free-form face, as far as seen [mm]; else 0."""


def _lay_out(
    shape: Any, faces: list[Any], forms: list[_Form], deflection: float, angular: float
) -> list[_Sheet | None]:
    """Return the triangles of every face; None where OpenCASCADE fails."""
    from OCP.BRepMesh import BRepMesh_IncrementalMesh
    from OCP.BRepTools import BRepTools

    BRepTools.Clean_s(shape)
    BRepMesh_IncrementalMesh(shape, deflection, False, angular, True)
    return [
        _triangles(face, form.kind == SurfaceKind.FREE_FORM)
        for face, form in zip(faces, forms, strict=True)
    ]


def _shape(path: Path) -> Any:
    """Return everything in the file as one shape."""
    from OCP.IFSelect import IFSelect_RetDone
    from OCP.Message import Message
    from OCP.STEPControl import STEPControl_Reader

    with path.open("rb") as stream:
        if b"ISO-10303-21" not in stream.read(4096):
            raise DataError("not a STEP file", path=path, hint="it begins with ISO-10303-21")
    messenger = Message.DefaultMessenger_s()
    printers = list(messenger.Printers())
    for printer in printers:  # its remarks are not our output
        messenger.RemovePrinter(printer)
    try:
        reader = STEPControl_Reader()
        if reader.ReadFile(str(path)) != IFSelect_RetDone:
            raise DataError("not a readable STEP file", path=path, hint="write or fetch it again")
        reader.TransferRoots()
        shape = reader.OneShape()
    finally:
        for printer in printers:
            messenger.AddPrinter(printer)
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


def _triangles(face: Any, free: bool) -> _Sheet | None:
    """Return the triangles of a face, None without; of a free-form one with normals and error."""
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
    corners = nodes[triangles]
    if not free or not mesh.HasUVNodes():
        return _Sheet(corners, np.zeros_like(corners), 0.0)
    places = np.array([mesh.UVNode(i).Coord() for i in range(1, mesh.NbNodes() + 1)])
    normals = _normals(face, places)[triangles]
    return _Sheet(corners, normals, _error(face, corners, normals, places[triangles]))


def _normals(face: Any, places: np.ndarray) -> np.ndarray:
    """Return the normal of the surface at (u, v); 0 where it has none; either sign."""
    from OCP.BRepAdaptor import BRepAdaptor_Surface
    from OCP.gp import gp_Pnt, gp_Vec

    surface = BRepAdaptor_Surface(face)
    point, along_u, along_v = gp_Pnt(), gp_Vec(), gp_Vec()
    rows = np.zeros((len(places), 2, 3))
    for i, (u, v) in enumerate(places.tolist()):
        surface.D1(u, v, point, along_u, along_v)
        rows[i] = along_u.Coord(), along_v.Coord()
    normals = np.cross(rows[:, 0], rows[:, 1])
    length: np.ndarray = np.linalg.norm(normals, axis=1, keepdims=True)
    scale = np.linalg.norm(rows, axis=2).max(initial=0.0) ** 2
    return np.where(length > 1e-9 * scale, normals / np.maximum(length, 1e-300), 0.0)


def _error(face: Any, corners: np.ndarray, normals: np.ndarray, places: np.ndarray) -> float:
    """Return the largest distance of the face from the curved patches over its triangles [mm].

    It is measured above the middle of triangles, evenly chosen where there are many.
    """
    from OCP.BRepAdaptor import BRepAdaptor_Surface

    surface = BRepAdaptor_Surface(face)
    # Where there is no normal, the one of the triangle will do: it cannot be told here.
    sound = np.flatnonzero((np.abs(normals).sum(axis=2) > 0.0).all(axis=1))
    sound = sound[:: -(-len(sound) // _CHECKED) or 1]
    if len(sound) == 0:
        return 0.0
    middle = places[sound].mean(axis=1).tolist()
    points = np.array([surface.Value(u, v).Coord() for u, v in middle])
    corners, normals = corners[sound], normals[sound]
    first = normals[:, :1]
    normals = normals * np.sign(np.einsum("ijk,ijk->ij", normals, first) + 1e-300)[:, :, None]
    share = shares(corners, points)
    gap = patch_points(corners, normals, share) - points
    return float(np.abs(np.einsum("ij,ij->i", gap, mixed(share, normals))).max())


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
