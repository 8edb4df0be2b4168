"""What `simulate` asks of the thing that it scans, and the answers of a CSG part."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from scanner_sim.part import FlatPart, Part
from scanner_sim.quadric import gradient
from scanner_sim.raycast import cast
from scanner_sim.scanner import StripeScanner
from scanner_sim.truth import build_truth

if TYPE_CHECKING:
    from octoseg_ti.types import Truth
    from scanner_sim.scanner import View

LIFT = 1e-6  # shadow rays start this far above the surface [mm]


class TargetHits(NamedTuple):
    """What rays hit; ``N`` rays."""

    distance: np.ndarray
    """Distance along the ray [mm], shape (N,), f64; infinite without a hit."""
    surface: np.ndarray
    """Number of the surface, shape (N,), i32; -1 without a hit."""
    normal: np.ndarray
    """Unit normal of the surface, away from the material, shape (N, 3), f64; 0 without a hit."""


class Target(Protocol):
    """A solid that can be scanned."""

    @property
    def name(self) -> str:
        """Name, for reports."""

    @property
    def box(self) -> np.ndarray:
        """Axis-aligned box around the solid [mm], shape (2, 3)."""

    @property
    def views(self) -> tuple[View, ...]:
        """Directions from which it is scanned, unless the scanner says otherwise."""

    @property
    def nominal_points(self) -> int | None:
        """Points that a scan shall have, unless the scanner says otherwise."""

    @property
    def stand_off(self) -> float | None:
        """Distance from which to scan it [mm] where the scanner's is left at its default."""

    @property
    def lift(self) -> float:
        """How far above the surface rays that leave it start [mm]."""

    @property
    def info(self) -> dict[str, str]:
        """How the solid came about, for the truth."""

    def trace(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> TargetHits:
        """Follow rays to the first surface.

        Args:
            origins: Starting points [mm], shape (N, 3).
            directions: Unit vectors, shape (N, 3).
            reach: Length of every ray [mm], shape (N,); hits beyond it do not count.
        """

    def hidden(
        self, positions: np.ndarray, normals: np.ndarray, directions: np.ndarray, reach: np.ndarray
    ) -> np.ndarray:
        """Return whether something stands in the way of points that `trace` has found.

        Args:
            positions: Points on the solid [mm], shape (N, 3).
            normals: Their normals, shape (N, 3).
            directions: Unit vectors, shape (N, 3).
            reach: Length of the way [mm], shape (N,).

        Returns:
            Flags, shape (N,), bool.
        """

    def truth(
        self, *, position: np.ndarray, normal: np.ndarray, surface: np.ndarray,
        stripe: np.ndarray, column: np.ndarray, reach: float, info: dict[str, str],
    ) -> Truth:  # fmt: skip
        """Return the truth about points that `trace` has found; see `build_truth`."""


class CsgTarget:
    """A CSG part under the rays."""

    def __init__(self, part: Part) -> None:
        """Flatten the part.

        Raises:
            DataError: The part is unbounded, or its tree is too deep.
        """
        self.part = part
        self.flat: FlatPart = part.flat()
        self.name, self.box, self.views = part.name, part.box, part.views
        self.nominal_points = part.nominal_points
        self.stand_off: float | None = None
        self.lift = LIFT
        self.info: dict[str, str] = {}

    def trace(self, origins: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> TargetHits:
        """Follow rays to the first surface of the solid."""
        hits = cast(self.flat, origins, directions, reach, from_outside=True)
        found = np.flatnonzero(hits.surface >= 0)
        position = origins[found] + hits.distance[found, None] * directions[found]
        normal = np.zeros((len(origins), 3))
        normal[found] = gradient(self.flat.surfaces, hits.surface[found], position)
        normal[found] *= hits.side[found, None]
        return TargetHits(hits.distance, hits.surface, normal)

    def hidden(
        self, positions: np.ndarray, normals: np.ndarray, directions: np.ndarray, reach: np.ndarray
    ) -> np.ndarray:
        """Return whether something stands in the way of points of the solid."""
        lifted = positions + self.lift * normals
        hits = cast(self.flat, lifted, directions, reach, from_outside=True)
        hidden: np.ndarray = hits.surface >= 0
        return hidden

    def truth(
        self, *, position: np.ndarray, normal: np.ndarray, surface: np.ndarray,
        stripe: np.ndarray, column: np.ndarray, reach: float, info: dict[str, str],
    ) -> Truth:  # fmt: skip
        """Return the truth about points that lie exactly on the part."""
        return build_truth(
            self.flat, position=position, normal=normal, surface=surface, stripe=stripe,
            column=column, reach=reach, info=info,
        )  # fmt: skip


def as_target(part: Part | Target) -> Target:
    """Return what can be scanned: a CSG part made ready, anything else as it is."""
    return CsgTarget(part) if isinstance(part, Part) else part


def far_enough(scanner: StripeScanner, target: Target) -> StripeScanner:
    """Return the scanner as far away as a solid asks for, if its stand-off is the default."""
    default = StripeScanner().stand_off
    if target.stand_off is None or not math.isclose(scanner.stand_off, default):
        return scanner
    return replace(scanner, stand_off=max(target.stand_off, default))
