"""A solid of triangles: what reads STEP, STL, OBJ and PLY gives, and what `simulate` can scan.

Where a surface has an exact form (the faces of a STEP file that are planes, cylinders, cones,
spheres and tori) the triangles only find it: the ray is then followed to the form itself. On the
free-form faces of a STEP file it is followed to curved patches over the triangles, which are
checked against the face when the file is read. On all other surfaces the triangle is the truth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from octoseg_ti.types import EdgeClass, SurfaceKind, Truth
from scanner_sim.bvh import Tree, build_tree, cast_triangles
from scanner_sim.curved import meet_patches, mixed, shares
from scanner_sim.nearest import Edges, nearest_edge
from scanner_sim.quadric import Surfaces, distance, gradient
from scanner_sim.scanner import StripeScanner, View
from scanner_sim.target import TargetHits
from scanner_sim.topology import Mesh
from scanner_sim.truth import find_patches

_STEPS = 8
_GRAZING = 0.02  # cosine below which a ray runs along a surface rather than into it
_LIFT = 1e-9  # shadow rays start at least this far above the surface, relative to the part
_SIDE = 0.25  # between two points of a face, it is looked for this far to either side, relative
_BETWEEN = (0.2, 0.4, 0.6, 0.8)
_COMMON = 100.0  # edges are looked up at this size [mm], whatever the size of the part


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class MeshPart:
    """A solid bounded by triangles, or open sheets; normals point to where the ray comes from.

    From outside of a closed solid that is the outer side. An open sheet can so be scanned from both
    sides.
    """

    mesh: Mesh
    """The triangles."""
    surface: np.ndarray
    """Surface of every triangle, shape (T,), i32."""
    normals: np.ndarray
    """Unit normal of the surface at the corners of every triangle, shape (T, 3, 3), f64."""
    surfaces: Surfaces
    """Kind of every surface, whether it is a fillet, and its exact form; NaN where there is none
    and the triangles are the truth."""
    edges: Edges
    """Where surfaces meet or end."""
    curved: np.ndarray
    """True where rays go on from the triangles of a surface to the curved patches over them, shape
    (S,), bool."""
    deflection: float = 0.0
    """Largest distance of a triangle from the exact form of its surface [mm]."""
    name: str = ""
    nominal_points: int | None = 90_000
    """Points that a scan shall have, unless the scanner says otherwise."""
    views: tuple[View, ...] = ()
    """Directions from which the part is scanned, unless the scanner says otherwise."""
    info: dict[str, str] = field(default_factory=dict)
    """How the part came about: format, unit, what was dropped."""
    tree: Tree = field(init=False, repr=False)
    box: np.ndarray = field(init=False)
    """Axis-aligned box around the solid [mm], shape (2, 3)."""
    size: float = field(init=False)
    """Length of the diagonal of the box [mm]."""

    def __post_init__(self) -> None:
        """Build the tree of boxes."""
        low, high = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        object.__setattr__(self, "box", np.stack([low, high]))
        object.__setattr__(self, "size", float(np.linalg.norm(high - low)))
        object.__setattr__(self, "tree", build_tree(self.mesh.corners(), self.surface))

    @property
    def stand_off(self) -> float | None:
        """Distance from which a part that is too large for the scanner's default is seen [mm]."""
        far = 1.5 * self.size
        return far if far > StripeScanner().stand_off else None

    @property
    def lift(self) -> float:
        """How far above the surface rays that leave it start [mm].

        The triangles of a hollow form lie above it, by the deflection at most; the rays begin a
        little more than that above the surface.
        """
        return 2.0 * self.deflection + _LIFT * self.size

    def trace(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> TargetHits:
        """Follow rays to the first surface; exact where the surface has an exact form."""
        # The triangle may lie a little behind the exact form, which is then within reach.
        far, triangle = cast_triangles(self.tree, origins, directions, reach)
        found = np.flatnonzero(triangle >= 0)
        surface = np.full(len(origins), -1, np.int32)
        normal = np.zeros((len(origins), 3))
        index = self.surface[triangle[found]]
        surface[found] = index
        ahead = directions[found]
        place = origins[found] + far[found, None] * ahead
        exact = np.flatnonzero(np.isfinite(self.surfaces.data[index, 0]))
        moved, fine = self._refined(index[exact], place[exact], ahead[exact])
        exact, moved = exact[fine], moved[fine]
        far[found[exact]] += moved
        on = place[exact] + moved[:, None] * ahead[exact]
        normal[found[exact]] = gradient(self.surfaces, index[exact], on)
        rest = np.ones(len(found), bool)
        rest[exact] = False
        bent = np.flatnonzero(rest & self.curved[index])
        plain = np.flatnonzero(rest & ~self.curved[index])
        corners = self.mesh.vertices[self.mesh.triangles[triangle[found]]]
        shading = self.normals[triangle[found]]
        moved, normal[found[bent]] = meet_patches(
            corners[bent], shading[bent], place[bent], ahead[bent]
        )
        far[found[bent]] += moved
        normal[found[plain]] = mixed(shares(corners[plain], place[plain]), shading[plain])
        away = np.einsum("ij,ij->i", normal, directions) > 0.0
        normal[away] *= -1.0
        return TargetHits(far, surface, normal)

    def _refined(
        self, index: np.ndarray, place: np.ndarray, ahead: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how far along its ray every point meets the exact form, and whether it does.

        Newton's method on the distance to the form. A ray that runs along the surface may miss the
        form and meet the triangle all the same; its point stays on the triangle, within the
        deflection. So does one whose step is out of proportion.
        """
        moved = np.zeros(len(place))
        left = np.arange(len(place))
        fine = np.zeros(len(place), bool)
        tiny = 1e-14 * (float(np.abs(self.box).max()) + self.size)
        for _ in range(_STEPS):
            point = place[left] + moved[left, None] * ahead[left]
            gap = distance(self.surfaces, index[left], point)
            slope = np.einsum("ij,ij->i", gradient(self.surfaces, index[left], point), ahead[left])
            steep = np.abs(slope) > _GRAZING
            step = np.where(steep, -gap / np.where(steep, slope, 1.0), 0.0)
            moved[left] += step
            done = steep & (np.abs(gap) <= 4.0 * tiny)
            fine[left[done]] = True
            left = left[steep & ~done]
        # What is not at rest to the last bit is at rest to the last but one, or not at all.
        if len(left):
            point = place[left] + moved[left, None] * ahead[left]
            fine[left] = np.abs(distance(self.surfaces, index[left], point)) <= 100.0 * tiny
        slope = np.abs(np.einsum("ij,ij->i", gradient(self.surfaces, index, place), ahead)).clip(
            _GRAZING
        )
        return moved, fine & (np.abs(moved) <= 10.0 * self.deflection / slope + 100.0 * tiny)

    def hidden(
        self, positions: np.ndarray, normals: np.ndarray, directions: np.ndarray, reach: np.ndarray
    ) -> np.ndarray:
        """Return whether something stands in the way of points that `trace` has found."""
        found = cast_triangles(
            self.tree, positions + self.lift * normals, directions, reach, any_hit=True
        )[1]
        hidden: np.ndarray = found >= 0
        return hidden

    def truth(
        self, *, position: np.ndarray, normal: np.ndarray, surface: np.ndarray,
        stripe: np.ndarray, column: np.ndarray, reach: float, info: dict[str, str],
    ) -> Truth:  # fmt: skip
        """Return the truth about points that `trace` has found; see `build_truth`."""
        scale = _COMMON / self.size
        edges = Edges(self.edges.start * scale, self.edges.end * scale, self.edges.kind)
        edge_distance, edge_class = nearest_edge(edges, position * scale)
        edge_distance /= scale

        def goes_on(pairs: np.ndarray) -> np.ndarray:
            return self._goes_on(position, normal, surface, pairs)

        patch = find_patches(
            self, position, surface, stripe, column, edge_distance, reach, goes_on=goes_on
        )
        on_fillet = self.surfaces.fillet[surface]
        edge_distance[on_fillet] = 0.0
        edge_class[on_fillet] = EdgeClass.FILLET
        return Truth(
            patch=patch, surface=surface, kind=self.surfaces.kind[surface].astype(np.int8),
            position=position, normal=normal, edge_distance=edge_distance.astype(np.float32),
            edge_class=edge_class, info={**info, **self.info},
        )  # fmt: skip

    def _goes_on(
        self, position: np.ndarray, normal: np.ndarray, surface: np.ndarray, pairs: np.ndarray
    ) -> np.ndarray:
        """Return whether a surface goes on between two points of it, shape (P,), bool.

        At places between the two, the surface must be met a little above or below the straight way.
        """
        whole = np.ones(len(pairs), bool)
        first, second = pairs.T
        mean = normal[first] + normal[second]
        length = np.linalg.norm(mean, axis=1, keepdims=True)
        mean = np.where(length > 1e-9, mean / np.maximum(length, 1e-300), normal[first])
        way = np.linalg.norm(position[second] - position[first], axis=1)
        half = _SIDE * way + 2.0 * self.deflection + _LIFT * self.size
        for share in _BETWEEN:
            left = np.flatnonzero(whole)
            middle = (1.0 - share) * position[first[left]] + share * position[second[left]]
            start = middle + half[left, None] * mean[left]
            met = cast_triangles(
                self.tree, start, -mean[left], 2.0 * half[left], any_hit=True,
                wanted=surface[first[left]],
            )[1]  # fmt: skip
            whole[left] = met >= 0
        return whole

    def summary(self) -> str:
        """Say in a line what the solid is made of."""
        kinds = np.bincount(self.surfaces.kind, minlength=len(SurfaceKind) - 1)
        named = [
            f"{count} {SurfaceKind(k).name.lower().replace('_', '-')}"
            for k, count in enumerate(kinds) if count
        ]  # fmt: skip
        size = " x ".join(f"{side:.4g}" for side in np.ptp(self.box, axis=0))
        return (
            f"{self.name}: {size} mm, {len(self.surface)} triangles, "
            f"{len(self.surfaces.kind)} surfaces ({', '.join(named)})"
        )


def no_form(count: int) -> np.ndarray:
    """Return the data of surfaces without an exact form, shape (count, 8)."""
    return np.full((count, 8), math.nan)
