"""How the views were aligned to each other, and by how much that moved them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Registration:
    """How the views were aligned to each other; ``P`` pairs of views were used."""

    recorded: np.ndarray
    """Poses as recorded: view to world, shape (V, 4, 4), f64; identity where none was given."""
    refined: np.ndarray
    """Poses after the refinement, shape (V, 4, 4), f64."""
    datum: np.ndarray
    """Views whose poses were kept fixed, one for each connected group, i32."""
    left: np.ndarray
    """Views left as recorded because they overlap too little with every other, i32."""
    open: np.ndarray
    """Directions of motion, 0..6, that the overlaps of a view leave open (one plane leaves three):
    along these it was not moved; shape (V,), i32."""
    pairs: np.ndarray
    """The pairs of views that were used, shape (P, 2), i32."""
    matches: np.ndarray
    """Matched points of every pair after the refinement, shape (P,), i32."""
    before: np.ndarray
    """Root mean square distance from point to plane by the recorded poses [mm], shape (P,)."""
    after: np.ndarray
    """... and by the refined poses [mm], shape (P,)."""

    @property
    def rms_before(self) -> float:
        """Distance from point to plane over all pairs by the recorded poses [mm]; NaN = no pair."""
        return self._over_all(self.before)

    @property
    def rms_after(self) -> float:
        """Distance from point to plane over all pairs by the refined poses [mm]; NaN = no pair."""
        return self._over_all(self.after)

    def _over_all(self, rms: np.ndarray) -> float:
        if len(rms) == 0:
            return float("nan")
        return float(np.sqrt(np.average(rms**2, weights=self.matches)))

    def change(self) -> np.ndarray:
        """Return the motions of the views in the world, shape (V, 4, 4); identity = not moved."""
        moved = (self.refined != self.recorded).any(axis=(1, 2))[:, None, None]
        return np.where(moved, self.refined @ np.linalg.inv(self.recorded), np.eye(4))

    def moves(self) -> tuple[np.ndarray, np.ndarray]:
        """Return by how much every pose has changed, in its own frame.

        Returns:
            Shift of the origin of the view [mm] and angle [rad], shape (V,) each.
        """
        moved = (self.refined != self.recorded).any(axis=(1, 2))[:, None, None]
        change = np.where(moved, np.linalg.inv(self.recorded) @ self.refined, np.eye(4))
        return np.linalg.norm(change[:, :3, 3], axis=1), rotation_angle(change)

    def __str__(self) -> str:
        """Say in a line what was aligned, and what was not."""
        if len(self.pairs) == 0:
            text = "registration: no two views overlap, all poses left as recorded"
        else:
            text = (
                f"registration: {len(self.pairs)} pairs of {len(self.recorded)} views, rms "
                f"{self.rms_before:.4f} -> {self.rms_after:.4f} mm"
            )
            if len(self.left):
                text += f", left as recorded (too little overlap): {_listed(self.left)}"
        loose = np.flatnonzero(self.open)
        if len(loose):
            text += f", not held in every direction: {_listed(loose)}"
        return text


def rotation_angle(motion: np.ndarray) -> np.ndarray:
    """Return by how much rigid motions of shape (..., 4, 4) turn [rad], shape (...)."""
    turn = motion[..., :3, :3]
    # The sine of a small angle, from the skew part, is exact where the cosine is not.
    skew = turn - np.swapaxes(turn, -1, -2)
    sine = np.linalg.norm(skew, axis=(-2, -1)) / np.sqrt(8.0)
    cosine = (np.trace(turn, axis1=-2, axis2=-1) - 1.0) / 2.0
    angle: np.ndarray = np.arctan2(sine, cosine)
    return angle


def _listed(views: np.ndarray) -> str:
    """Return the numbers of views as text."""
    return ("view " if len(views) == 1 else "views ") + ", ".join(map(str, views.tolist()))
