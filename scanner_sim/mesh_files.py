"""Triangles from STL, OBJ and PLY files, with the labels of faces where a file has them.

STL and OBJ are read here: both are a page of code, and general mesh packages drop what is wanted,
the groups of an OBJ file. PLY is read by plyfile.
"""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from octoseg_ti.errors import DataError

LABELS = ("label", "face_id", "surface", "segment", "patch", "group")
"""Names of the property of PLY faces that says to which face of the solid a triangle belongs."""
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)")
_LISTS = ("vertex_indices", "vertex_index")


class Soup(NamedTuple):
    """Triangles as a file has them; ``T`` triangles."""

    corners: np.ndarray
    """Corners, in the unit of the file, shape (T, 3, 3), f64."""
    label: np.ndarray | None
    """Face of every triangle, 0..., shape (T,); None where the file says nothing."""


def read_stl(path: Path) -> Soup:
    """Read binary or ASCII STL.

    Raises:
        DataError: It is neither, or cut off.
    """
    content = path.read_bytes()
    if len(content) >= 84:
        count = int(np.frombuffer(content, "<u4", 1, 80)[0])
        if len(content) == 84 + 50 * count:
            layout = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("rest", "<u2")])
            return Soup(np.frombuffer(content, layout, count, 84)["corner"].astype(float), None)
    if not content.lstrip()[:5].lower() == b"solid":
        what = "not an STL file"
        if len(content) >= 84 and len(content) < 84 + 50 * count:
            what = f"not an STL file, or cut off: {count} triangles need {84 + 50 * count} bytes"
        raise DataError(what, path=path, hint="an ASCII or binary STL file is wanted")
    found = _VERTEX.findall(content.lower())
    facets = len(re.findall(rb"\bfacet\s+normal\b", content.lower()))
    if len(found) != 3 * facets or not content.rstrip()[-2048:].lower().count(b"endsolid"):
        what = f"damaged ASCII STL: {facets} facets, {len(found)} vertices"
        raise DataError(what, path=path, hint="write or fetch it again")
    try:
        corners = np.array(found, dtype="S").astype(float) if found else np.empty((0, 3))
    except ValueError as error:
        raise DataError(f"damaged ASCII STL ({error})", path=path) from error
    return Soup(corners.reshape(-1, 3, 3), None)


def read_obj(path: Path) -> Soup:
    """Read the polygons of a Wavefront OBJ file; its groups (``g``) are the labels of faces.

    Raises:
        DataError: A line is no OBJ, or names a vertex that is not there.
    """
    vertices: list[list[float]] = []
    triangles: list[tuple[int, int, int]] = []
    label: list[int] = []
    groups: dict[str, int] = {}
    current = 0
    text = path.read_bytes().decode("utf-8", "replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if not words:
            continue
        try:
            if words[0] == "v":
                vertices.append([float(w) for w in words[1:4]])
                if len(words) < 4:
                    raise ValueError("a vertex has three coordinates")
            elif words[0] == "g":
                current = groups.setdefault(" ".join(words[1:]), len(groups))
            elif words[0] == "f":
                ring = [_place(w, len(vertices)) for w in words[1:]]
                if len(ring) < 3:
                    raise ValueError("a face has three vertices or more")
                triangles += [(ring[0], b, c) for b, c in pairwise(ring[1:])]
                label += [current] * (len(ring) - 2)
        except ValueError as error:
            raise DataError(f"not an OBJ file (line {number}: {error})", path=path) from error
    corners = np.array(vertices, float).reshape(-1, 3)[np.array(triangles, int).reshape(-1, 3)]
    return Soup(corners, _several(np.array(label, int)))


def _place(word: str, count: int) -> int:
    """Return the vertex that a word like 3/1/2 or -1 names."""
    number = int(word.split("/")[0])
    place = number - 1 if number > 0 else count + number
    if number == 0 or not 0 <= place < count:
        raise ValueError(f"vertex {number} of {count}")
    return place


def read_ply(path: Path) -> Soup:
    """Read the polygons of a PLY file; a property of its faces may name their face of the solid.

    Raises:
        DataError: It is no PLY, or has no faces.
    """
    from plyfile import PlyData, PlyParseError

    try:
        content = PlyData.read(str(path))
    except (PlyParseError, ValueError, UnicodeDecodeError, MemoryError) as error:
        reason = " ".join(str(error).split())[:160]
        raise DataError(f"not a readable PLY file ({reason})", path=path) from error
    if "vertex" not in content or "face" not in content:
        hint = "a mesh is wanted; point clouds go to octoseg segment"
        raise DataError("the PLY file has no faces", path=path, hint=hint)
    vertex, face = content["vertex"].data, content["face"].data
    names = face.dtype.names or ()
    lists = [name for name in _LISTS if name in names]
    if not lists or not {"x", "y", "z"}.issubset(vertex.dtype.names or ()):
        raise DataError("the PLY file lacks x, y, z or vertex_indices", path=path)
    points = np.stack([vertex[k] for k in "xyz"], axis=1).astype(float)
    rings = face[lists[0]]
    length = np.fromiter(map(len, rings), int, len(rings))
    triangles, owner = [np.empty((0, 3), int)], [np.empty(0, int)]
    for sides in np.unique(length[length >= 3]):
        own = np.flatnonzero(length == sides)
        ring = np.stack(rings[own]).astype(int)
        for k in range(1, sides - 1):
            triangles.append(ring[:, [0, k, k + 1]])
            owner.append(own)
    corner, source = np.concatenate(triangles), np.concatenate(owner)
    if len(corner) and (corner.min() < 0 or corner.max() >= len(points)):
        raise DataError(f"a face names a vertex beyond the {len(points)}", path=path)
    named = [name for name in LABELS if name in names]
    label = None
    if named:
        label = _several(np.unique(face[named[0]], return_inverse=True)[1][source])
    return Soup(points[corner], label)


def _several(label: np.ndarray) -> np.ndarray | None:
    """Return labels if they tell faces apart; one label for all says nothing."""
    if len(label) == 0 or label.min() == label.max():
        return None
    return np.unique(label, return_inverse=True)[1]
