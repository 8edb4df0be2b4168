"""How surfaces move by the unknowns of the fit, in plain NumPy."""

from __future__ import annotations

import numpy as np

from reference.surfaces import CONE, PLANE, SPHERE, TORUS


def moved(state: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return states after steps.

    Args:
        state: Shape (G, KINDS, STATE).
        step: Shape (G, KINDS, UNKNOWNS).

    Returns:
        Shape (G, KINDS, STATE).
    """
    point, axis, u = state[..., :3], state[..., 3:6], state[..., 6:9]
    v = np.cross(axis, u)
    half = state[:, CONE, 9]
    bend, taper = np.cos(half) - step[:, CONE, 5], np.sin(half) + step[:, CONE, 6]
    opened = np.zeros(step.shape[:2])
    opened[:, CONE] = np.angle((bend + 1j * taper) * np.exp(-1j * half))
    flatter = 1.0 - step[..., 5]
    flatter[:, CONE] = np.hypot(bend, taper)
    radius = _anchor_radii(state)
    grown = radius / flatter
    turn = (
        step[..., 2, None] * u + (step[..., 3] - opened)[..., None] * v + step[..., 4, None] * axis
    )
    angle = np.linalg.norm(turn, axis=-1, keepdims=True)
    about = turn / np.maximum(angle, 1e-300)

    def turned(x: np.ndarray) -> np.ndarray:
        along = np.sum(about * x, axis=-1, keepdims=True) * about
        return along + np.cos(angle) * (x - along) + np.sin(angle) * np.cross(about, x)

    to_axis, to_u = _unit(turned(axis)), turned(u)
    to_u = _unit(to_u - np.sum(to_u * to_axis, axis=-1, keepdims=True) * to_axis)
    shifted = point + step[..., 0, None] * u + step[..., 1, None] * axis
    before, after = u.copy(), to_u.copy()
    before[:, SPHERE], after[:, SPHERE] = axis[:, SPHERE], to_axis[:, SPHERE]
    shifted += radius[..., None] * before - grown[..., None] * after
    shape = np.stack((grown, state[..., 10]), axis=-1)
    shape[:, PLANE] = 0.0
    shape[:, CONE, 0] = half + opened[:, CONE]
    shape[:, CONE, 1] += grown[:, CONE] * np.cos(shape[:, CONE, 0])
    shape[:, CONE, 1] -= radius[:, CONE] * np.cos(half)
    shape[:, TORUS, 1] += step[:, TORUS, 6]
    return np.concatenate((shifted, to_axis, to_u, shape), axis=-1)


def _anchor_radii(state: np.ndarray) -> np.ndarray:
    radius = state[..., 9].copy()
    radius[:, PLANE] = 0.0
    point, axis = state[:, CONE, :3], state[:, CONE, 3:6]
    cosine = np.maximum(np.abs(np.cos(state[:, CONE, 9])), 1e-9)
    size = np.minimum(np.abs(state[:, CONE, 10]) / cosine, 1.0)
    off = point - np.sum(point * axis, axis=-1, keepdims=True) * axis
    radius[:, CONE] = np.maximum(np.linalg.norm(off, axis=-1), size)
    return radius


def _unit(v: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.divide(v, size, out=np.full_like(v, np.nan), where=size > 0)
