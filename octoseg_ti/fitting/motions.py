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

from typing import Any

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
the curvature at the anchor (its sign turned, so that the radius grows), and the tube radius of a
torus. A cone with half angle h at the distance r from its axis has the curvature cos h / r and the
taper sin h / r: these two change, in units of 1 / r, while the line through the anchor stays."""

FREE = np.zeros((KINDS, UNKNOWNS), bool)
"""The unknowns that move a surface of every kind."""
FREE[PLANE, [1, 2, 3]] = True
FREE[CYLINDER, [0, 2, 3, 4, 5]] = True
FREE[CONE, [0, 2, 3, 4, 5, 6]] = True
FREE[SPHERE, [1, 2, 3, 5]] = True
FREE[TORUS] = True

STATE = 11
"""Numbers of a state."""

_TURN = 0.5  # the most that a step turns [rad], opens or bends: derivatives hold no farther
_GROWTH = 0.75  # the largest relative change of a curvature

vec7: Any = ti.types.vector(7, ti.f64)


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
    if kind == SPHERE:
        arm = vec3(q[0], q[1], q[2] - anchor)
        bend = anchor * (n[2] - 1.0)
    turned = arm.cross(n)
    if kind == CONE:
        # A larger half angle, with the axis turned so that the line through the anchor stays.
        open_up = turned[1] - (rho - anchor) * shape[3] - q[2] * shape[2]
        other = shape[2] * open_up - shape[3] * bend
        bend = shape[2] * bend + shape[3] * open_up
    return f[0], vec7(-n[0], -n[2], -turned[0], -turned[1], -turned[2], bend, other)


@ti.func
def bounded(kind: ti.i32, step: vec7) -> vec7:
    """Return the step, shortened as a whole where it turns or bends more than can be foretold."""
    most = ti.max(ti.abs(step[2]), ti.abs(step[3]), ti.abs(step[4])) / _TURN
    most = ti.max(most, ti.abs(step[5]) / _GROWTH)
    if kind == CONE:
        most = ti.max(most, ti.abs(step[6]) / _TURN)
    return step / ti.max(most, 1.0)


@ti.func
def _turned(x: vec3, turn: vec3) -> vec3:
    """Return a vector turned about an axis by its length (Rodrigues)."""
    angle = turn.norm()
    about = turn / ti.max(angle, 1e-300)
    along = about.dot(x) * about
    return along + ti.cos(angle) * (x - along) + ti.sin(angle) * about.cross(x)


@ti.func
def step_state(kind: ti.i32, point: vec3, axis: vec3, u: vec3, shape: vec4, step: vec7):
    """Return (point, axis, u, a, b) after a step."""
    v = axis.cross(u)
    radius = anchor_radius(kind, point, axis, shape)
    flatter = 1.0 - step[5]
    opened = 0.0
    if kind == CONE:
        bend = shape[2] - step[5]
        taper = shape[3] + step[6]
        opened = ti.atan2(taper * shape[2] - bend * shape[3], bend * shape[2] + taper * shape[3])
        flatter = ti.sqrt(bend * bend + taper * taper)
    grown = radius / flatter
    turn = step[2] * u + (step[3] - opened) * v + step[4] * axis
    to_axis = _turned(axis, turn).normalized()
    to_u = _turned(u, turn)
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
        a = shape[0] + opened
        b = shape[1] - radius * shape[2] + grown * ti.cos(a)
    elif kind == TORUS:
        b = shape[1] + step[6]
    return shifted, to_axis, to_u, a, b
