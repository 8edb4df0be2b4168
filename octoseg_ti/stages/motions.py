"""How a surface moves: seven unknowns that all kinds share, counted from an anchor near the points.

A shallow piece of a large sphere says much about where the surface passes and which way it faces,
little about its curvature, and next to nothing about its centre. So shifts and turns are taken
about an anchor beside the points (on the surface; for a torus on the ring), which stays in place
while the radius changes by way of its reciprocal. Radius and centre then do not chase each other
(compare Lukacs, Martin & Marshall 1998, Faithful least-squares fitting of spheres, cylinders, cones
and tori).

A state is (point, axis, u, a, b) in units of the extent of the group about its centre: the point on
the axis, u across the axis towards the points (of a sphere, the axis points to them), and the shape
as `profile` reads it.
"""

import numpy as np

from octoseg_ti.device.linalg import vec3
from octoseg_ti.device.runtime import ti
from octoseg_ti.device.surfaces import (
    CONE,
    CYLINDER,
    KINDS,
    PLANE,
    SPHERE,
    TORUS,
    profile,
    vec4,
)

UNKNOWNS = 7
"""Shift along u and along the axis, turns about u, v = axis x u and the axis, relative change of
the curvature at the anchor (its sign turned, so that the radius grows), and half angle of a cone
or tube radius of a torus."""

FREE = np.zeros((KINDS, UNKNOWNS), bool)
"""The unknowns that move a surface of every kind."""
FREE[PLANE, [1, 2, 3]] = True
FREE[CYLINDER, [0, 2, 3, 4, 5]] = True
FREE[CONE, [0, 2, 3, 4, 5, 6]] = True
FREE[SPHERE, [1, 2, 3, 5]] = True
FREE[TORUS] = True

STATE = 11
"""Numbers of a state."""

_AROUND = 0.9  # of the way to zero curvature: the most that a step goes
_TIGHTER = 9.0  # and the most that it goes the other way

vec7 = ti.types.vector(7, ti.f64)


@ti.func
def is_free(kind: ti.i32, k: ti.i32) -> ti.i32:
    """Return 1 if unknown ``k`` moves a surface of this kind; bits in the order of `FREE`."""
    bits = 0b1111111
    if kind == PLANE:
        bits = 0b0001110
    elif kind == CYLINDER:
        bits = 0b0111101
    elif kind == CONE:
        bits = 0b1111101
    elif kind == SPHERE:
        bits = 0b0101110
    return (bits >> k) & 1


@ti.func
def anchor_radius(kind: ti.i32, point: vec3, axis: vec3, shape: vec4) -> ti.f64:
    """Return how far the anchor is from the point of the state, along u (sphere: the axis)."""
    radius = shape[0]
    if kind == PLANE:
        radius = 0.0
    elif kind == CONE:
        # The points are that far from the axis; around the axis, the surface is.
        size = ti.min(ti.abs(shape[1]) / ti.max(ti.abs(shape[2]), 1e-9), 1.0)
        radius = ti.max((point - point.dot(axis) * axis).norm(), size)
    return radius


@ti.func
def change_of_distance(kind: ti.i32, q: vec3, shape: vec4, anchor: ti.f64):
    """Return the distance of a point in the frame of a state, and its change by the unknowns.

    A surface shifted by s and turned by w about the anchor moves by n.s + w.(q x n), q from there.
    """
    rho = ti.sqrt(q[0] * q[0] + q[1] * q[1])
    f = profile(kind, rho, q[2], shape)
    c = f[1] / ti.max(rho, 1e-12)
    n = vec3(c * q[0], c * q[1], f[2])
    arm = vec3(q[0] - anchor, q[1], q[2])
    bend = anchor * (n[0] - f[1])
    other = -1.0
    if kind == CONE:
        other = -(rho - anchor) * shape[3] - q[2] * shape[2]
    elif kind == SPHERE:
        arm = vec3(q[0], q[1], q[2] - anchor)
        bend = anchor * (n[2] - 1.0)
    turned = arm.cross(n)
    return f[0], vec7(-n[0], -n[2], -turned[0], -turned[1], -turned[2], bend, other)


@ti.func
def step_state(kind: ti.i32, point: vec3, axis: vec3, u: vec3, shape: vec4, step: vec7):
    """Return (point, axis, u, a, b) after a step."""
    v = axis.cross(u)
    turn = step[2] * u + step[3] * v + step[4] * axis
    radius = anchor_radius(kind, point, axis, shape)
    grown = radius / (1.0 - ti.min(ti.max(step[5], -_TIGHTER), _AROUND))
    to_axis = (axis + turn.cross(axis)).normalized()
    to_u = u + turn.cross(u)
    to_u = (to_u - to_u.dot(to_axis) * to_axis).normalized()
    shifted = point + step[0] * u + step[1] * axis
    a = grown
    b = shape[1]
    if kind == SPHERE:
        shifted += radius * axis - grown * to_axis
    else:
        shifted += radius * u - grown * to_u
    if kind == PLANE:
        a = 0.0
    elif kind == CONE:
        a = shape[0] + step[6]
        b = shape[1] - radius * shape[2] + grown * ti.cos(a)
    elif kind == TORUS:
        b = shape[1] + step[6]
    return shifted, to_axis, to_u, a, b


def moved(state: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return states after steps: `step_state` for the host.

    Args:
        state: Shape (G, KINDS, STATE).
        step: Shape (G, KINDS, UNKNOWNS).

    Returns:
        Shape (G, KINDS, STATE).
    """
    point, axis, u = state[..., :3], state[..., 3:6], state[..., 6:9]
    v = np.cross(axis, u)
    turn = step[..., 2, None] * u + step[..., 3, None] * v + step[..., 4, None] * axis
    radius = _anchor_radii(state)
    grown = radius / (1.0 - np.clip(step[..., 5], -_TIGHTER, _AROUND))
    to_axis = _unit(axis + np.cross(turn, axis))
    to_u = u + np.cross(turn, u)
    to_u = _unit(to_u - np.sum(to_u * to_axis, axis=-1, keepdims=True) * to_axis)
    shifted = point + step[..., 0, None] * u + step[..., 1, None] * axis
    before, after = u.copy(), to_u.copy()
    before[:, SPHERE], after[:, SPHERE] = axis[:, SPHERE], to_axis[:, SPHERE]
    shifted += radius[..., None] * before - grown[..., None] * after
    shape = np.stack((grown, state[..., 10]), axis=-1)
    shape[:, PLANE] = 0.0
    angle = state[:, CONE, 9]
    shape[:, CONE, 0] = angle + step[:, CONE, 6]
    shape[:, CONE, 1] += grown[:, CONE] * np.cos(shape[:, CONE, 0])
    shape[:, CONE, 1] -= radius[:, CONE] * np.cos(angle)
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
    return v / np.linalg.norm(v, axis=-1, keepdims=True)
