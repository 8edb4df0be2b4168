"""Every option of the segmentation, declared once: meaning, unit, default.

A value of None means "derive it from the data"; the result holds the parameters with every None
filled in. The command line, its help, the saved configuration and the documentation come from here.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import typing
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal


@dataclass(frozen=True, slots=True)
class Range:
    """The values that a number may have, both ends among them, or all above the lower one."""

    least: float
    most: float = math.inf
    above: bool = False

    def __contains__(self, value: object) -> bool:
        if not isinstance(value, numbers.Real) or not self.least <= float(value) <= self.most:
            return False
        return float(value) > self.least or not self.above

    def __str__(self) -> str:
        if self.most == math.inf:
            return f"{'above' if self.above else 'at least'} {self.least:g}"
        return f"{self.least:g}..{self.most:g}"


Length = Annotated[float, Range(0.0)]
"""A length, [mm]."""
Angle = Annotated[float, Range(0.0)]
"""An angle, [rad]."""
Share = Annotated[float, Range(0.0, 1.0)]
"""A part of a whole."""
Count = Annotated[int, Range(0)]
"""A number of things."""


@functools.cache
def _ranges(section: Any) -> dict[str, Range]:
    """Return the range of every number of a section."""
    found = {}
    for name, hint in typing.get_type_hints(section, include_extras=True).items():
        for part in (hint, *typing.get_args(hint)):
            for mark in typing.get_args(part)[1:]:
                if isinstance(mark, Range):
                    found[name] = mark
    return found


class _Section:
    """Parameters of one step, whose numbers lie in their ranges."""

    __slots__ = ()

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ValueError: One is outside its range, or none; the message names it.
        """
        for name, allowed in _ranges(typing.cast(Hashable, type(self))).items():
            value = getattr(self, name)
            if value is not None and value not in allowed:
                raise ValueError(f"{type(self).__name__}: {name} must be {allowed}, not {value!r}")


@dataclass(frozen=True, slots=True, kw_only=True)
class CleaningParams(_Section):
    """Marking of spikes, isolated points and detached groups (I3)."""

    enabled: bool = True
    """Mark spikes, isolated points and small detached groups before normals are estimated; and,
    where the position of the probe at every stripe is known, regions that it cannot have seen:
    mirror images behind the surface of the part."""
    spike: Length | None = None
    """Smallest distance of a spike from the surfaces around it [mm]; default: from noise and
    spacing."""
    isolation: Length | None = None
    """Neighbours that are farther than this do not hold a point [mm]; default: from the spacing."""
    detached: Count | None = None
    """A group of fewer points is an outlier where no other points and no other view hold it; 0 =
    keep every group. Default: from the spacing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class NormalParams(_Section):
    """Point normals from edge pairs of neighbouring stripes (N1-N9)."""

    rule: Literal["diagonal", "paper"] = "diagonal"
    """Next point of the march: by the shorter diagonal, or by the distance along y (the paper)."""
    gap: Length | None = None
    """Longest edge of a triangle [mm]; longer ones break the strip. Default: from the spacing."""
    weight: Literal["unit", "area"] | None = None
    """Mean of unit normals (Eq. 1), or weighted by the area of the triangles. Default: by area
    where noisy normals are filtered, for there the errors of heights cancel out; else unit."""
    smooth: Count | None = None
    """Passes of the filter that smooths normals within faces and keeps edges; 0 = off. Default:
    from their noise, 0 where it is below the least tolerance; 3 when the input has no stripes."""
    neighbors: Annotated[int, Range(3)] = 12
    """Neighbours of a point when the input has no stripes (I8)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RegistrationParams(_Section):
    """Alignment of the views to each other (I6)."""

    refine: bool = False
    """Align overlapping views by ICP, from the recorded poses on. Needs the extra "icp"."""
    reach: Length | None = None
    """Farthest partner of a point in another view [mm]; default: from the spacing."""
    overlap: Share = 0.05
    """Least share of the smaller of two views that must have partners in the other, 0..1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GridParams(_Section):
    """The sparse octree of normals (G1-G8)."""

    divisions: Annotated[int, Range(1)] | None = None
    """Cells along the shortest side of the bounding box; default: the cell is a power of two
    times the smallest cell."""
    tolerance: Share | None = None
    """Largest deviation of the normals in a cell (Eq. 4), 0..1; default: from their noise."""
    edge_tolerance: Share | None = None
    """Largest deviation of the normals in a smallest cell that is no edge; default: from the noise
    and the spacing. Below ``tolerance`` it has no effect."""
    min_cell: Length | None = None
    """Smallest cell [mm]; default: from the spacing. 0 = no limit."""
    min_points: Count = 3
    """A cell with fewer points is not split."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeParams(_Section):
    """Which cells are edges (S1-S3)."""

    rule: Literal["reason", "levels", "radius"] = "reason"
    """By why a cell stopped, by its level (paper), or by the radius that its size stands for."""
    smallest_levels: Count = 4
    """Rule "levels": how many of the smallest cell sizes are edges."""
    fillet_levels: Count = 0
    """Rule "levels": how many of these sizes, from the largest down, are fillets."""
    radius: Length = 1.0
    """Rule "radius": smallest radius that is still a patch [mm]; s = sqrt(12) tolerance radius."""
    fillet_radius: Length = 3.0
    """Largest radius of a fillet [mm], with analytic surfaces: a strip that touches its neighbours
    on both sides stands for an edge up to this radius, and for a patch beyond it; 0 = no fillets.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class RegionParams(_Section):
    """Flood fill over touching cells (S4-S7), and what happens to the points left over."""

    homogeneity: Angle | None = None
    """Largest angle between the normals of touching cells [rad]; default: from the tolerance."""
    min_points: Count | None = None
    """A group with fewer points is no patch; default: from the smallest cell and the spacing."""
    assign_edges: bool = True
    """Give edge points to the neighbouring patch that they fit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurfaceParams(_Section):
    """Analytic surfaces through the regions, and the points that lie on them (F1)."""

    enabled: bool = True
    """Explain regions by planes, cylinders, cones, spheres and tori: split and merge by them, and
    give every point to the surface that it fits."""
    noise: Length | None = None
    """Deviation of a point from its surface [mm]; default: from the data."""
    tilt: Annotated[float, Range(0.0, above=True)] | None = None
    """Deviation of its normal [rad]; default: from the noise of the normals."""
    turn: Angle | None = None
    """Largest angle between the normals of a point and of its surface [rad]; default: from the
    noise, wider where the position of a point tells more."""
    min_points: Count | None = None
    """A surface with fewer points is none; default: fewer than of a patch where points lie close to
    their surface."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Params:
    """All parameters of `segment`."""

    cleaning: CleaningParams = field(default_factory=CleaningParams)
    normals: NormalParams = field(default_factory=NormalParams)
    registration: RegistrationParams = field(default_factory=RegistrationParams)
    grid: GridParams = field(default_factory=GridParams)
    edges: EdgeParams = field(default_factory=EdgeParams)
    regions: RegionParams = field(default_factory=RegionParams)
    surfaces: SurfaceParams = field(default_factory=SurfaceParams)

    def to_dict(self) -> dict[str, Any]:
        """Return nested plain values, for JSON."""
        return dataclasses.asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Params:
        """Build parameters from nested plain values.

        Raises:
            ValueError: A key is unknown; the message names it.
        """
        sections: dict[str, Any] = {
            "cleaning": CleaningParams,
            "normals": NormalParams,
            "registration": RegistrationParams,
            "grid": GridParams,
            "edges": EdgeParams,
            "regions": RegionParams,
            "surfaces": SurfaceParams,
        }
        built = {}
        for name, section in values.items():
            if name not in sections:
                raise ValueError(
                    f"unknown parameter section {name!r}; known: {', '.join(sections)}"
                )
            known = {f.name for f in dataclasses.fields(sections[name])}
            for key in section:
                if key not in known:
                    raise ValueError(
                        f"unknown parameter {name}.{key}; known: {', '.join(sorted(known))}"
                    )
            built[name] = sections[name](**section)
        return cls(**built)


def paper(
    *,
    divisions: int = 12,
    tolerance: float = 0.01,
    smallest_levels: int = 4,
    fillet_levels: int = 0,
    homogeneity: float = math.radians(20.0),
    min_points: int = 30,
) -> Params:
    """Return the parameters of the literal method of Woo et al. 2002, with its user values.

    Args:
        divisions: Cells along the shortest side of the bounding box (section 3.3).
        tolerance: Largest deviation of the normals in a cell (Eq. 4).
        smallest_levels: How many of the smallest cell sizes are edges (section 3.4).
        fillet_levels: How many of these are fillets, counted from the largest.
        homogeneity: Largest angle between the mean normals of merged cells [rad].
        min_points: Smallest group that a surface can be fitted to.
    """
    return Params(
        cleaning=CleaningParams(enabled=False),
        normals=NormalParams(rule="paper", weight="unit", smooth=0),
        grid=GridParams(
            divisions=divisions,
            tolerance=tolerance,
            edge_tolerance=tolerance,
            min_cell=0.0,
            min_points=2,
        ),
        edges=EdgeParams(
            rule="levels", smallest_levels=smallest_levels, fillet_levels=fillet_levels
        ),
        regions=RegionParams(homogeneity=homogeneity, min_points=min_points, assign_edges=False),
        surfaces=SurfaceParams(enabled=False),
    )


PRESETS: dict[str, Callable[[], Params]] = {"default": Params, "paper": paper}
"""Named parameter sets."""


def preset_params(name: str) -> Params:
    """Return the parameters of a preset.

    Raises:
        ValueError: There is no such preset; the message names those there are.
    """
    if name not in PRESETS:
        raise ValueError(f"preset must be one of {', '.join(PRESETS)}, not {name!r}")
    return PRESETS[name]()
