"""The stripe scanner: a laser plane, a camera beside it, and the directions of its passes.

In the frame of a view the stage moves along x, the laser line lies along y, and z points to the
probe. The laser fans out from a point ``stand_off`` above the plane z = 0; the camera sits beside
it in the direction of x and looks at the line under the triangulation angle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from octoseg_ti.errors import DataError


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """The direction from which one pass looks at the part."""

    tilt: float = 0.0
    """Angle between the probe's axis and the vertical [rad]; 0 = from above."""
    azimuth: float = 0.0
    """Direction of the tilt around the vertical, from the x axis [rad]."""
    turn: float = 0.0
    """Turn of the probe about its own axis [rad]; at 0 the camera sits above the laser."""
    offset: float = 0.0
    """Shift of the whole pass along the laser line [mm]; 0 = over the middle of the part."""

    def rotation(self) -> np.ndarray:
        """Return the rotation from the view to the world, shape (3, 3)."""
        c, s = math.cos(self.azimuth), math.sin(self.azimuth)
        z = np.array([math.sin(self.tilt) * c, math.sin(self.tilt) * s, math.cos(self.tilt)])
        x = np.array([-math.cos(self.tilt) * c, -math.cos(self.tilt) * s, math.sin(self.tilt)])
        y = np.cross(z, x)
        turned = math.cos(self.turn) * x + math.sin(self.turn) * y
        return np.stack([turned, np.cross(z, turned), z], axis=1)


def around(*tilts_and_counts: tuple[float, int]) -> tuple[View, ...]:
    """Return views in rings: for every (tilt [rad], count) that many views around the vertical."""
    return tuple(
        View(tilt=tilt, azimuth=2.0 * math.pi * k / count)
        for tilt, count in tilts_and_counts
        for k in range(count)
    )


DEFAULT_VIEWS = around((0.0, 1), (math.radians(65.0), 4))
"""From above and from four sides: what `simulate` does for a part that names no views."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StripeScanner:
    """A laser stripe probe on a stage. A value of None means: chosen for the part."""

    stand_off: float = 300.0
    """Distance from the laser to the middle of the part [mm]. Left at its default, a part from a
    file that is too large for it is seen from 1.5 times the diagonal of its box."""
    triangulation_angle: float = math.radians(30.0)
    """Angle between laser plane and camera, seen from the middle of the part [rad]."""
    stripe_pitch: float | None = None
    """Distance from stripe to stripe [mm]; None = as fine as the wanted number of points asks."""
    point_pitch: float | None = None
    """Distance of the laser's rays on the plane z = 0 [mm]; None = stripe pitch / ``aspect``."""
    aspect: float = 1.25
    """Stripe pitch over point pitch, where one of them is left open."""
    points: int | None = None
    """Exact number of points of the scan; None = as the part says, or as many as come."""
    range_noise: float = 0.01
    """Standard deviation of the position along the line of sight [mm]."""
    dropout: float = 0.005
    """Share of the points that get lost, one by one."""
    lost_ends: float = 1.0
    """Mean number of points that are lost at either end of a stripe."""
    lost_stripes: float = 0.0
    """Share of the stripes that get lost as a whole."""
    incidence_limit: float = math.radians(60.0)
    """Largest angle between the laser and the normal of the surface [rad]."""
    camera_limit: float = math.radians(85.0)
    """Largest angle between the line to the camera and the normal of the surface [rad]."""
    field_of_view: float | None = None
    """Length of the laser line on the plane z = 0 [mm], around the middle of the part; None = as
    wide as the part."""
    depth_of_field: float | None = None
    """Depth around the plane z = 0 within which points are measured [mm]; None = all."""
    pose_noise: float = 0.0
    """Standard deviation of the error of a recorded pose along each axis [mm]; the first view is
    the datum and has none."""
    pose_angle_noise: float = 0.0
    """Standard deviation of the error of a recorded pose about each axis [rad]; as above."""
    stripe_rate: float = 60.0
    """Stripes a second."""
    views: tuple[View, ...] | None = None
    """The passes; None = as the part says, else `DEFAULT_VIEWS`."""

    def __post_init__(self) -> None:
        """Check every value.

        Raises:
            DataError: A value is outside its range; the message names it.
        """
        for name in ("stand_off", "aspect", "stripe_rate"):
            self._check(name, getattr(self, name) > 0.0, "above 0")
        for name in ("stripe_pitch", "point_pitch", "points", "field_of_view", "depth_of_field"):
            value = getattr(self, name)
            self._check(name, value is None or value > 0, "above 0")
        for name in ("range_noise", "lost_ends", "pose_noise", "pose_angle_noise"):
            self._check(name, getattr(self, name) >= 0.0, "0 or more")
        for name in ("dropout", "lost_stripes"):
            self._check(name, 0.0 <= getattr(self, name) < 1.0, "at least 0 and below 1")
        for name in ("incidence_limit", "camera_limit", "triangulation_angle"):
            self._check(name, 0.0 < getattr(self, name) < math.pi / 2, "between 0 and pi/2")
        self._check("views", self.views is None or len(self.views) > 0, "None or at least one view")

    def _check(self, name: str, fine: bool, what: str) -> None:
        value = getattr(self, name)
        finite = not isinstance(value, float) or math.isfinite(value)
        if not (fine and finite):
            raise DataError(f"StripeScanner: {name} must be {what}, not {value}")

    @property
    def camera(self) -> np.ndarray:
        """Position of the camera relative to the laser [mm], view frame, shape (3,)."""
        return np.array([self.stand_off * math.tan(self.triangulation_angle), 0.0, 0.0])
