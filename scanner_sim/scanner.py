"""The stripe scanner: a laser plane, a camera beside it, and the directions of its passes.

In the frame of a view the stage moves along x, the laser line lies along y, and z points to the
probe. The laser fans out from a point ``stand_off`` above the plane z = 0; the camera sits beside
it in the direction of x and looks at the line under the triangulation angle. Laser and camera are
equally high, so a row of the detector sees exactly one ray of the fan: one point a row and stripe.

Every effect has one parameter, and a value at which it is off; all of them are off by default but
the range noise and the losses. `scanner_sim.presets` has whole scanners.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

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

MAX_SUB_RAYS = 25
EFFECTS = (
    "line_width", "quantisation", "incidence_noise", "horizon", "speckle", "specular",
    "saturation", "threshold", "encoder_jitter", "encoder_error", "backlash",
)  # fmt: skip
"""Parameters that switch an effect of the measurement on; 0 or None is off."""


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
    """Standard deviation of the position along the line of sight [mm], at normal incidence."""
    line_width: float = 0.0
    """Width of the laser line [mm], between the places where its Gaussian intensity has fallen to
    1/e^2 (four standard deviations); 0 = exactly one ray a point, without effects at edges."""
    sub_rays: int = 9
    """Rays over the width of the line, an odd number from 3 to 25; without a width it is one."""
    pixel: float = 0.05
    """Width of a detector pixel [mm], seen at the middle of the part, across the line of sight."""
    blur: float = 3.0
    """Spots closer together than this on the detector have one peak [pixel]."""
    quantisation: float = 0.0
    """Step of the peak position on the detector [pixel], such as 0.0625; 0 = exact."""
    incidence_noise: float = 0.0
    """Growth of the range noise with the angle of incidence a, as cos(a)^-x; 0 = none, 0.5 = photon
    noise of a matte surface."""
    horizon: float = 0.0
    """Standard deviation of the further scatter where laser or camera graze a silhouette [mm]; it
    fades as exp(-(cos(a) / 0.2)^2) of the larger angle a; 0 = none."""
    speckle: float = 0.0
    """Contrast C of the laser's speckle, 0 to 1: depth scatters by C wavelength / (2 pi sin u sin
    theta), alike along the stripe over the width of the spot; 0 = none."""
    wavelength: float = 0.00066
    """Wavelength of the laser [mm]."""
    aperture: float = 0.03
    """Sine of the half angle u under which the part sees the lens of the camera."""
    specular: float = 0.0
    """Share of the light that the part reflects like a mirror, 0 to 1: a glossy lobe in its
    brightness, and spikes where the mirrored line hits the part again; 0 = matte."""
    lobe: float = math.radians(10.0)
    """Standard deviation of the glossy lobe [rad]."""
    saturation: float | None = None
    """Brightness at which a pixel is full, in that of a matte surface at normal incidence; beyond
    it the peak widens and the range noise grows with the root of the excess; None = never."""
    threshold: float = 0.0
    """Brightness below which there is no point, in that of a matte surface at normal incidence;
    0 = none."""
    encoder_jitter: float = 0.0
    """Standard deviation of the stage's position, stripe by stripe [mm]."""
    encoder_error: float = 0.0
    """Amplitude of the periodic error of the stage [mm]."""
    encoder_period: float = 2.0
    """Period of that error [mm]."""
    backlash: float = 0.0
    """Way that the drive turns at the start of a pass before the stage follows [mm]; the stage then
    stays behind by as much."""
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
        for name in ("stand_off", "aspect", "stripe_rate", "pixel", "wavelength", "encoder_period"):
            self._check(name, getattr(self, name) > 0.0, "above 0")
        for name in ("stripe_pitch", "point_pitch", "points", "field_of_view", "depth_of_field",
                     "saturation"):  # fmt: skip
            value = getattr(self, name)
            self._check(name, value is None or value > 0, "above 0")
        for name in ("range_noise", "lost_ends", "pose_noise", "pose_angle_noise", "line_width",
                     "blur", "quantisation", "incidence_noise", "horizon", "threshold",
                     "encoder_jitter", "encoder_error", "backlash"):  # fmt: skip
            self._check(name, getattr(self, name) >= 0.0, "0 or more")
        for name in ("speckle", "specular"):
            self._check(name, 0.0 <= getattr(self, name) <= 1.0, "between 0 and 1")
        self._check("aperture", 0.0 < self.aperture < 1.0, "between 0 and 1")
        odd = self.sub_rays % 2 == 1 and 3 <= self.sub_rays <= MAX_SUB_RAYS
        self._check("sub_rays", odd, f"an odd number from 3 to {MAX_SUB_RAYS}")
        for name in ("dropout", "lost_stripes"):
            self._check(name, 0.0 <= getattr(self, name) < 1.0, "at least 0 and below 1")
        for name in ("incidence_limit", "camera_limit", "triangulation_angle", "lobe"):
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

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects that are on, beside range noise and losses."""
        return tuple(name for name in EFFECTS if getattr(self, name))

    @staticmethod
    def preset(name: str, **overrides: Any) -> StripeScanner:
        """Return a scanner of `scanner_sim.presets.SCANNERS`, with other values where given.

        Raises:
            DataError: There is none of this name, or a value is outside its range.
        """
        from scanner_sim.presets import scanner

        return scanner(name, **overrides)
