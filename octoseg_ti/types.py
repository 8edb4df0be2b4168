"""What flows between the parts of octoseg: frozen groups of arrays, and the closed sets of codes.

Lengths are millimetres, angles radians, normals unit length and pointing to the probe. ``N`` is the
number of points, ``V`` of views, ``S`` of stripes, ``C`` of cells, ``K`` of patches.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from octoseg_ti.alignment import Registration as Registration
from octoseg_ti.alignment import rotation_angle as rotation_angle

if TYPE_CHECKING:
    from octoseg_ti.params import Params

NONE = -1
"""The label of a point that belongs to no patch."""

_SHALLOW_EDGE = 3.0  # where the noise hides edges above this angle [deg], that is said
# A wedge with sides of width w that meet at an angle a leaves this times a w (root mean square) of
# the parabola that fits it best; told apart is what stands out by so many noises.
_WEDGE = 0.0361
_STAND_OUT = 2.0
_EDGE_WIDTH = 40.0  # spacings


class SurfaceKind(IntEnum):
    """Kind of the analytic surface of a patch."""

    NONE = -1
    """Not determined."""
    PLANE = 0
    CYLINDER = 1
    CONE = 2
    SPHERE = 3
    TORUS = 4
    FREE_FORM = 5


class EdgeClass(IntEnum):
    """Why a point counts as an edge point."""

    NONE = 0
    SHARP = 1
    FILLET = 2
    SMOOTH = 3
    """A joint where the normal is continuous and the curvature is not."""


class Artefact(IntEnum):
    """What is wrong with a measured point, beyond the noise that the scanner states."""

    CLEAN = 0
    MIXED = 1
    """An edge of the part or of a shadow cuts the laser line: the peak lies between two surfaces,
    or on one side of the line."""
    SPIKE = 2
    """The peak is a mirror image: the laser was reflected and hit the part a second time."""
    MULTI_BOUNCE = 3
    """Mirrored light beside the line pulls the peak, as in a corner."""


class StopReason(IntEnum):
    """Why a cell was not split further."""

    HOMOGENEOUS = 0
    """The deviation of its normals is within the tolerance."""
    MIN_SIZE = 1
    """Its daughters would be smaller than the smallest cell."""
    FEW_POINTS = 2
    """It holds too few points to be split."""
    MAX_LEVEL = 3
    """The deepest level that a key can address was reached."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scans:
    """Points of one or several views, in the order in which the scanner delivered them.

    Points of a stripe are stored one after the other, in order along the stripe; stripes are stored
    in scan order. Without ``stripe`` the points are unorganised.
    """

    points: np.ndarray
    """Positions [mm], shape (N, 3), f64, in the frame named by ``frame``."""
    normals: np.ndarray | None = None
    """Unit normals, shape (N, 3), f64, same frame; None when they are still to be estimated."""
    stripe: np.ndarray | None = None
    """Stripe number of every point, shape (N,), i32, non-decreasing within a view. Numbers are
    unique over all views; a number may be missing (a lost line)."""
    column: np.ndarray | None = None
    """Position along the stripe (detector row), shape (N,), i32: gaps show missing samples."""
    view: np.ndarray | None = None
    """View number of every point, shape (N,), i32; None means one view."""
    time_ns: np.ndarray | None = None
    """Time of every point since the start of the recording [ns], shape (N,), i64."""
    T_world_view: np.ndarray | None = None
    """Pose of every view: maps view to world, shape (V, 4, 4), f64."""
    origin: np.ndarray | None = None
    """A probe position of every view [mm], world frame, shape (V, 3), f64: tells the outer side."""
    stripe_origin: np.ndarray | None = None
    """Probe position at every stripe [mm], world frame, shape (S, 3), S = largest stripe + 1;
    NaN where it is not known."""
    frame: str = "world"
    """Frame of ``points`` and ``normals``: "world", or "view" (then ``T_world_view`` is given)."""
    name: str = ""
    """Where the scans come from, for reports."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Truth:
    """What is known for sure about every point, from the simulator or from labelled data.

    Only ``patch`` is always there.
    """

    patch: np.ndarray
    """Patch of every point, shape (N,), i32, 0..K-1 by size; -1 = no patch (a fillet strip, a
    mirror image, not labelled). A patch is a connected visible piece of one surface. A mixed point
    has the patch of the surface that most of its light came from."""
    surface: np.ndarray | None = None
    """Surface (face of the construction) of every point, shape (N,), i32."""
    kind: np.ndarray | None = None
    """`SurfaceKind` of every point's surface, shape (N,), i8."""
    position: np.ndarray | None = None
    """True position [mm], world frame, shape (N, 3), f64."""
    normal: np.ndarray | None = None
    """True unit normal, world frame, shape (N, 3), f64."""
    edge_distance: np.ndarray | None = None
    """Distance to the nearest true edge [mm], shape (N,), f32; 0 on a fillet strip."""
    edge_class: np.ndarray | None = None
    """`EdgeClass` of that nearest edge, shape (N,), u8."""
    T_world_view: np.ndarray | None = None
    """True pose of every view: maps view to world, shape (V, 4, 4), f64."""
    artefact: np.ndarray | None = None
    """`Artefact` of every point, shape (N,), u8; None when the measurement is not known to have
    any."""
    info: dict[str, str] = field(default_factory=dict)
    """How the truth came about: part, seed, noise."""
    radius: np.ndarray | None = None
    """Radius of the fillet that a point lies on [mm], shape (N,), f32; NaN on no fillet."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.patch)

    @property
    def patch_count(self) -> int:
        """Number of true patches."""
        return int(self.patch.max(initial=NONE)) + 1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cells:
    """The leaves of the sparse grid, in Morton order."""

    corner: np.ndarray
    """Lower corner [mm], world frame, shape (C, 3), f64."""
    size: np.ndarray
    """Edge length [mm], shape (C,), f64."""
    level: np.ndarray
    """Level, 0 = initial cell, shape (C,), i8."""
    count: np.ndarray
    """Points in the cell, shape (C,), i32."""
    normal: np.ndarray
    """Normalised mean normal, shape (C, 3), f32."""
    sigma: np.ndarray
    """Deviation of the normals (Eq. 4), shape (C,), f32."""
    stop: np.ndarray
    """`StopReason`, shape (C,), u8."""
    edge: np.ndarray
    """`EdgeClass` of the cell, shape (C,), u8."""
    label: np.ndarray
    """Patch of the cell after the flood fill, shape (C,), i32; -1 = none."""
    initial_size: float
    """Edge length of the initial cells [mm]."""

    def __len__(self) -> int:
        """Return the number of cells."""
        return len(self.size)


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement:
    """What was measured on the data, and what the default derived from it."""

    spacing_along: float
    """Median distance of neighbours on a stripe [mm] (unorganised: nearest neighbours)."""
    spacing_across: float
    """Median distance between neighbouring stripes [mm] (unorganised: as along)."""
    noise: float
    """Estimated standard deviation of the range noise [mm]."""
    normal_noise: float
    """Estimated deviation of a point normal from the surface normal [rad]."""
    surface_noise: float = 0.0
    """Estimated standard deviation of points about the smooth surface through their neighbourhood
    [mm]: noise, and what neighbours share of it; 0 = not measured."""
    view_noise: float = 0.0
    """... of the views from the surfaces that they share [mm], a part of the surface noise: errors
    of the poses, which all points of a view have in common; 0 = the views meet, or not measured."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Fillets:
    """The fillets of a part: strips that a ball leaves that rolls along two patches; ``F`` of them.

    The points of a strip keep the label that they have, that of a patch of their own where the
    strip is wide enough to be one, up to the lines where the ball touches the sides; `strip` tells
    which patches are strips. A corner where several
    fillets meet may be a fillet of its own, between one fillet and the next patch.
    """

    patches: np.ndarray
    """The two patches that a fillet runs between, shape (F, 2), i32."""
    radius: np.ndarray
    """Radius of the ball [mm], shape (F,), f64."""
    deviation: np.ndarray
    """Standard deviation of the radius [mm], shape (F,), f64."""
    concave: np.ndarray
    """1 where the fillet fills a corner, 0 where it rounds an edge, shape (F,), u8."""
    points: np.ndarray
    """Points on the fillet, shape (F,), i32."""
    strip: np.ndarray
    """Fillet that every patch is a strip of, -1 = it is no strip, shape (K,), i32."""
    point: np.ndarray
    """Fillet that every point lies on, -1 = none, shape (N,), i32."""

    def __len__(self) -> int:
        """Return the number of fillets."""
        return len(self.radius)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Segmentation:
    """The answer of `segment`, in the order of the input points."""

    points: np.ndarray
    """Positions [mm], world frame, shape (N, 3), f64."""
    normals: np.ndarray
    """Unit normals pointing to the probe, world frame, shape (N, 3), f32; 0 where there is none."""
    labels: np.ndarray
    """Patch of every point, 0..K-1 by size, shape (N,), i32; -1 = none."""
    edge: np.ndarray
    """`EdgeClass` of every point, shape (N,), u8."""
    level: np.ndarray
    """Level of the cell that holds the point, shape (N,), i8; -1 = in no cell."""
    outlier: np.ndarray
    """1 where cleaning marked the point, shape (N,), u8."""
    kind: np.ndarray
    """`SurfaceKind` of every patch, shape (K,), i8."""
    surface: np.ndarray
    """Surface of every patch, shape (K,), i32: patches of one surface share a number."""
    parameters: np.ndarray
    """Surface parameters of every patch, shape (K, 8), f64: point (3), axis or normal (3), a, b;
    a = radius (cylinder, sphere, torus ring), half angle (cone); b = tube radius (torus). NaN where
    there is none."""
    covariance: np.ndarray
    """Covariance of these parameters, shape (K, 8, 8), f64: rows and columns in their order, point
    [mm], axis or normal (components of a unit vector, so that small deviations are angles [rad]),
    a [mm; cone: rad], b [mm]. NaN in the rows and columns of what a kind has not (plane: a and b;
    sphere: axis and b; cylinder, cone: b), and everywhere for a free form, no kind, or too few
    points.

    To first order: s^2 (J'J)^-1 over the points that the surface was fitted to (at most
    600, evenly spread over all its patches, which share one covariance; all points of a plane
    found without the search for surfaces). s is what these points leave, not what was assumed; on
    exact data that is rounding. It takes their errors for independent. What neighbours share is not
    in it: errors of the poses, of the calibration, of a whole stripe or view, or of the form
    (`measured.view_noise` is the part that the views show). Nor is the choice of kind and points:
    on simulated parts with sharp edges errors are as large as this says, beside fillets, whose ends
    faces take with them, about twice. Short arcs, of which centre or apex are far from sure, err
    more than the first order says.

    It is singular: a unit vector changes only across itself; the point of a plane only along the
    normal, that of a cylinder only across the axis, for elsewhere it is free. So compare with the
    nearest point of another such surface, and invert by the eigenvalues that are not rounding. It
    holds at the point given: the offset n.p of a plane has the variance g C g', g = (n, p, 0, 0),
    which grows with the distance of the origin from the points. A shift of the frame changes
    nothing, a turn R gives M C M' with M = diag(R, R, 1, 1), and the opposite normal M = diag(1,
    -1, 1, 1)."""
    residual: np.ndarray
    """Root mean square distance of the points to the surface [mm], shape (K,); NaN = none."""
    cells: Cells
    """The final grid."""
    stripe: np.ndarray | None = None
    """Stripe numbers of the input, shape (N,), i32."""
    view: np.ndarray | None = None
    """View numbers of the input, shape (N,), i32."""
    params: Params
    """The parameters, with every value that was left open filled in."""
    measured: Measurement
    """What was measured on the data."""
    fillets: Fillets | None = None
    """Fillets and their radii; None when they were not looked for."""
    registration: Registration | None = None
    """How the views were aligned; None when the recorded poses were used as they are."""
    passes: int
    """Subdivision passes that split a cell, plus one for the initial grid."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of every stage [s], in order."""
    name: str = ""
    """Where the scans came from."""

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.labels)

    @property
    def patch_count(self) -> int:
        """Number of patches."""
        return len(self.kind)

    @property
    def patch_sizes(self) -> np.ndarray:
        """Points of every patch, shape (K,), i64."""
        return np.bincount(self.labels[self.labels >= 0], minlength=self.patch_count)

    @property
    def deviation(self) -> np.ndarray:
        """Standard deviation of every parameter by `covariance`, shape (K, 8); NaN = none."""
        return np.sqrt(np.einsum("kii->ki", self.covariance))

    @property
    def level_count(self) -> int:
        """Number of distinct cell sizes."""
        return len(np.unique(self.cells.level))

    @property
    def edge_width(self) -> float:
        """Width of the faces that `shallowest_edge` is stated for [mm]: 40 point spacings."""
        return _EDGE_WIDTH * max(self.measured.spacing_along, self.measured.spacing_across)

    @property
    def shallowest_edge(self) -> float:
        """Angle above which an edge between two faces is told from a bend [rad].

        Two faces that meet at a shallow angle look like one that is bent. How far they are from it
        has to stand out from ``surfaces.noise``, and grows with the angle and the width: faces
        twice as wide as `edge_width` show half of this angle. Between it and about a third of it
        edges are found by chance. NaN where no surfaces were looked for.
        """
        noise, width = self.params.surfaces.noise, self.edge_width
        if not self.params.surfaces.enabled or noise is None or not width > 0.0:
            return math.nan
        return min(_STAND_OUT * noise / (_WEDGE * width), math.pi)

    def told_edges(self) -> tuple[str, str]:
        """Say which edges the noise allows to tell: between what faces, and from what angle on."""
        angle = math.degrees(self.shallowest_edge)
        hidden = "; the noise hides shallower ones" if angle > _SHALLOW_EDGE else ""
        faces = f"edges between faces {self.edge_width:.3g} mm wide are told from"
        return faces, f"{angle:.2g} deg on{hidden}"

    def __str__(self) -> str:
        """Say in a few lines what was found, and how."""
        labelled = float(np.mean(self.labels >= 0)) if len(self) else 0.0
        lines = [
            f"Segmentation: {len(self)} points, {self.patch_count} patches, "
            f"{labelled:.1%} labelled, {int(np.count_nonzero(self.edge))} edge points, "
            f"{int(self.outlier.sum())} outliers",
            f"  {len(self.cells)} cells in {self.level_count} sizes, "
            f"tolerance {self.params.grid.tolerance:.3g}, "
            f"normal noise {self.measured.normal_noise:.3g} rad, "
            f"spacing {self.measured.spacing_along:.3g} / {self.measured.spacing_across:.3g} mm",
        ]
        if self.registration is not None:
            lines.append(f"  {self.registration}")
        sizes = self.patch_sizes
        for k in range(min(self.patch_count, 12)):
            kind = SurfaceKind(int(self.kind[k])).name.lower().replace("_", "-")
            rms = "" if np.isnan(self.residual[k]) else f", rms {self.residual[k]:.4f} mm"
            lines.append(f"  patch {k}: {kind}, {sizes[k]} points{rms}")
        if self.patch_count > 12:
            lines.append(f"  ... and {self.patch_count - 12} smaller ones")
        if self.fillets is not None and len(self.fillets):
            radius = self.fillets.radius
            lines.append(
                f"  {len(radius)} fillets, radius {radius.min():.3g} to {radius.max():.3g} mm"
            )
        if not math.isnan(self.shallowest_edge):
            lines.append("  " + " ".join(self.told_edges()))
        if self.seconds:
            stages = ", ".join(f"{name} {1e3 * s:.1f}" for name, s in self.seconds.items())
            lines.append(f"  milliseconds: {stages}")
        return "\n".join(lines)
