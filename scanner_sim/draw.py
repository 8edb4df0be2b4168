"""What random blocks draw: lengths, angles, and the finish of edges by family."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from scanner_sim.features import SHARP, Rim

if TYPE_CHECKING:
    import numpy as np

FAMILIES = ("sharp", "filleted", "smooth", "mixed")
"""The families of random blocks."""

WIDE = 2.0
"""Every patch is at least this wide where the scanner sees it [mm]."""

SIGHT = 0.7
"""The walls of a hole are seen down to this depth, in units of half its width."""

FILLET = (0.75, 3.0)
"""Radii of fillets [mm]."""

BLEND = (3.5, 6.0)
"""Radii of blends on features [mm]; those of bodies go up to 12 mm."""

CHAMFER = (1.5, 3.0)
"""Legs of chamfers [mm]; their faces are 1.4 times as wide."""


class Draw:
    """Random numbers in the manner of a drawing: lengths in steps of 0.01 mm."""

    def __init__(self, generator: np.random.Generator, family: str) -> None:
        """Draw for one of the families."""
        self.generator = generator
        self.family = family

    def number(self, low: float, high: float) -> float:
        """Return a length between two others [mm]."""
        return round(float(self.generator.uniform(low, high)), 2)

    def chance(self, share: float) -> bool:
        """Return True in this share of all cases."""
        return bool(self.generator.random() < share)

    def pick(self, names: dict[str, float]) -> str:
        """Return one of the names, by weight."""
        weights = list(names.values())
        total = sum(weights)
        return str(self.generator.choice(list(names), p=[w / total for w in weights]))

    def angle(self) -> float:
        """Return the turn of a feature on its deck [rad]: often along the body or across."""
        if self.chance(0.75):
            return 0.0 if self.chance(0.5) else math.pi / 2
        return float(self.generator.uniform(0.0, math.pi))

    def rim(self, limit: float, *, blend: float = 0.0) -> Rim:
        """Return the finish of an edge.

        Args:
            limit: Radius or legs that leave enough of the faces beside the edge [mm].
            blend: The same for a blend [mm]; 0 = no blend.
        """
        style = self.style()
        if style == "smooth" and blend >= BLEND[0]:
            return Rim(round=self.number(BLEND[0], min(BLEND[1], blend)))
        if style == "filleted" and limit >= FILLET[0]:
            return Rim(round=self.number(FILLET[0], min(FILLET[1], limit)))
        if style == "chamfered" and limit >= CHAMFER[0]:
            return Rim(chamfer=self.number(CHAMFER[0], min(CHAMFER[1], limit)))
        return SHARP

    def style(self) -> str:
        """Return how an edge is finished: sharp, chamfered, filleted or smooth."""
        if self.family == "sharp":
            return self.pick({"sharp": 0.65, "chamfered": 0.35})
        if self.family == "mixed":
            return self.pick({"sharp": 0.3, "chamfered": 0.15, "filleted": 0.35, "smooth": 0.2})
        return self.family
