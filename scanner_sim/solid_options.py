"""How files of solids are read: every option once, with unit and default."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from octoseg_ti.errors import DataError

SUFFIXES = (".step", ".stp", ".stl", ".obj", ".ply")
"""The files that `read_part` reads."""
MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
"""Millimetres per unit."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SolidOptions:
    """How a STEP file or a triangle mesh becomes a part. None means: chosen for the part."""

    unit: Literal["mm", "cm", "m", "inch"] = "mm"
    """Unit of a mesh file, which does not say it; a STEP file does."""
    smooth_angle: float | None = None
    """Triangles of a mesh that meet at a smaller angle belong to one face [rad]; None = in the
    middle of the widest range between 10 and 60 degrees in which the mesh has no angle, or 30
    degrees."""
    face_labels: bool = True
    """The groups of an OBJ file and the labels of PLY faces are the faces of the mesh, where there
    are any; off, smooth groups are."""
    deflection: float | None = None
    """Distance of the triangles from the surfaces of a STEP file [mm]; None = 1/20,000 of the
    diagonal of its box, or less where free-form faces need it. Planes, cylinders, cones, spheres
    and tori are hit exactly all the same, free-form faces within 1/100,000 of the diagonal."""
    angular_deflection: float = math.radians(6.0)
    """Angle between neighbouring triangles on the surfaces of a STEP file [rad]."""
    fillet_radius: float | None = None
    """Cylinders, spheres and tori of a STEP file that join two faces or more smoothly, with a
    radius up to this, are fillets: edges, not patches [mm]; 0 = none, None = 1/40 of the diagonal
    of the box."""

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            DataError: A value is outside its range; the message names it.
        """
        for name, low, high in (("smooth_angle", 0.0, math.pi), ("deflection", 0.0, math.inf),
                                ("angular_deflection", 0.0, math.pi)):  # fmt: skip
            value = getattr(self, name)
            if value is not None and not (low < value < high and math.isfinite(value)):
                raise DataError(f"SolidOptions: {name} must be above 0, not {value}")
        radius = self.fillet_radius
        if radius is not None and not (radius >= 0.0 and math.isfinite(radius)):
            raise DataError(f"SolidOptions: fillet_radius must be 0 or more, not {radius}")
        if self.unit not in MM:
            known = ", ".join(MM)
            raise DataError(f"SolidOptions: unit must be one of {known}, not {self.unit!r}")
