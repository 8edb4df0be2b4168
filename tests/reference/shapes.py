"""Triangles of simple solids, and files of them, made by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def cube(side: float = 20.0, low: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Corners of the 12 triangles of a cube, anticlockwise from outside, shape (12, 3, 3)."""
    v = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * side + low
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return np.array([v[[q[0], q[i], q[i + 1]]] for q in quads for i in (1, 2)])


def lathe(radii: np.ndarray, heights: np.ndarray, turns: int) -> np.ndarray:
    """Triangles of a solid of revolution about z from its outline, closed where a radius is 0."""
    angle = 2.0 * np.pi * np.arange(turns) / turns
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    found = []
    for k in range(len(radii) - 1):
        for i in range(turns):
            j = (i + 1) % turns
            low = [[*(radii[k] * ring[m]), heights[k]] for m in (i, j)]
            high = [[*(radii[k + 1] * ring[m]), heights[k + 1]] for m in (i, j)]
            if radii[k] > 0:
                found.append([low[0], low[1], high[1]])
            if radii[k + 1] > 0:
                found.append([low[0], high[1], high[0]])
    return np.array(found, float)


def ball(radius: float = 10.0, turns: int = 48) -> np.ndarray:
    """Triangles of a ball."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, turns // 2 + 1)
    radii = radius * np.cos(angle)
    radii[[0, -1]] = 0.0
    return lathe(radii, radius * np.sin(angle), turns)


def rod(radius: float = 5.0, height: float = 12.0, turns: int = 48) -> np.ndarray:
    """Triangles of a cylinder with flat ends."""
    return lathe(np.array([0, radius, radius, 0]), np.array([0, 0, height, height]), turns)


def write_stl(path: Path, corners: np.ndarray) -> Path:
    """Write binary STL."""
    layout = np.dtype([("normal", "<f4", 3), ("corner", "<f4", (3, 3)), ("rest", "<u2")])
    rows = np.zeros(len(corners), layout)
    rows["corner"] = corners
    path.write_bytes(b"made by hand".ljust(80) + np.uint32(len(rows)).tobytes() + rows.tobytes())
    return path


def write_ascii_stl(path: Path, corners: np.ndarray) -> Path:
    """Write ASCII STL."""
    lines = ["solid made by hand"]
    for triangle in corners:
        lines += [" facet normal 0 0 0", "  outer loop"]
        lines += ["   vertex " + " ".join(f"{v:.9g}" for v in corner) for corner in triangle]
        lines += ["  endloop", " endfacet"]
    path.write_text("\n".join([*lines, "endsolid"]))
    return path


def write_obj(path: Path, corners: np.ndarray, groups: np.ndarray | None = None) -> Path:
    """Write OBJ, every triangle with vertices of its own."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners.reshape(-1, 3)]
    for t in range(len(corners)):
        if groups is not None:
            lines.append(f"g face{groups[t]}")
        lines.append(f"f {3 * t + 1}/1/1 {3 * t + 2} {3 * t + 3}")
    path.write_text("# by hand\n" + "\n".join(lines) + "\n")
    return path


def write_ply(path: Path, corners: np.ndarray, label: np.ndarray | None = None) -> Path:
    """Write ASCII PLY, every triangle with vertices of its own."""
    n = len(corners)
    head = ["ply", "format ascii 1.0", f"element vertex {3 * n}"]
    head += [f"property double {k}" for k in "xyz"] + [f"element face {n}"]
    head += ["property list uchar int vertex_indices"]
    head += ["property int label"] if label is not None else []
    rows = [f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in corners.reshape(-1, 3)]
    for t in range(n):
        own = "" if label is None else f" {label[t]}"
        rows.append(f"3 {3 * t} {3 * t + 1} {3 * t + 2}{own}")
    path.write_text("\n".join([*head, "end_header", *rows]) + "\n")
    return path
