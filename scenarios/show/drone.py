"""Meshes in space for scenes of flights: the quadrotor, tubes along its ways, ellipses of what it believes.

A mesh is a pair (vertices (n, 3) [m], faces (m, 3)), as in `unifg.scenarios.show.shapes`.
"""

from __future__ import annotations

import math

import numpy as np

from unifg.scenarios.show.shapes import Mesh, merge, ring
from unifg.typing import Array, ArrayLike, IntArray

__all__ = ["arms", "body", "box", "ellipse_axes", "nose", "quads", "rotors", "swept", "thin", "tube", "unit_disc"]

_ROTOR, _LEVEL = 0.36, 0.17  # radius and height of the rotors over the radius of the vehicle
_APART = 1e-4  # neighbours nearer than this are one point [m]
_ANGLES = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)


def body(radius: float) -> Mesh:
    """The hull in the middle of a vehicle of that radius [m], nose along x."""
    return box(np.zeros(3), np.array([0.52, 0.34, 0.22]) * radius)


def nose(radius: float) -> Mesh:
    """A block at the front of the hull, to tell front from back."""
    return box(np.array([0.34, 0.0, 0.02]) * radius, np.array([0.2, 0.26, 0.16]) * radius)


def arms(radius: float) -> Mesh:
    """Two crossed beams that carry the rotors, and the posts of those."""
    reach = (1.0 - _ROTOR) * radius
    ends = reach * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(4)])
    beams = [tube(ends[[k, k + 2]], 0.055 * radius, sides=4) for k in range(2)]
    posts = [box(end + np.array([0.0, 0.0, 0.06 * radius]), np.array([0.1, 0.1, 0.2]) * radius) for end in ends]
    return merge(beams + posts)


def rotors(radius: float, *, front: bool) -> Mesh:
    """The two rotors at the front or at the back, as rings with a bar across; outermost points at the radius."""
    size, meshes = _ROTOR * radius, []
    for centre in _hubs(radius, front):
        rim = ring(centre, 0.84 * size, 0.16 * size, _LEVEL * radius, corners=24)
        across = 0.9 * size * np.array([-centre[1], centre[0]]) / np.linalg.norm(centre)
        blade = np.column_stack([np.stack([centre - across, centre + across]), np.full(2, _LEVEL * radius)])
        meshes += [rim, tube(blade, 0.05 * radius, sides=4)]
    return merge(meshes)


def swept(radius: float, *, front: bool) -> Mesh:
    """The discs these rotors sweep."""
    size = _ROTOR * radius
    return merge([ring(hub, 0.0, size, 0.99 * _LEVEL * radius, corners=24) for hub in _hubs(radius, front)])


def _hubs(radius: float, front: bool) -> Array:
    """(2, 2) axes of the rotors at the front or at the back."""
    angles = _ANGLES[[0, 3]] if front else _ANGLES[[1, 2]]
    hubs: Array = (1.0 - _ROTOR) * radius * np.column_stack([np.cos(angles), np.sin(angles)])
    return hubs


def box(centre: ArrayLike, size: ArrayLike) -> Mesh:
    """A box (3,) [m] around a centre (3,) [m], its faces apart, so that shading keeps edges sharp."""
    signs = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], dtype=np.float64)
    sides = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            side = np.full((4, 3), sign)
            side[:, [(axis + 1) % 3, (axis + 2) % 3]] = signs if sign > 0.0 else signs[::-1]
            sides.append(side)
    return quads(np.asarray(centre) + 0.5 * np.asarray(size) * np.stack(sides))


def quads(corners: Array) -> Mesh:
    """Quadrilaterals (n, 4, 3) as two triangles each."""
    return corners.reshape(-1, 3), _repeated([[0, 1, 2], [0, 2, 3]], 4, len(corners))


def tube(points: Array, radius: float, sides: int = 3) -> Mesh:
    """A tube of few sides along a polyline, open at its ends.

    Args:
        points: (n, 3) [m], n >= 2; neighbours may coincide.
        radius: [m].
        sides: of the cross section.

    Returns:
        ``sides`` n vertices and 2 ``sides`` (n - 1) faces.
    """
    tangent = np.gradient(points, axis=0)
    tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    # Any two directions across the tangent do, as long as they turn little from point to point.
    away = np.array([0.0, 0.0, 1.0]) if np.abs(tangent[:, 2]).max() < 0.9 else np.array([0.31, 0.95, 0.0])
    first = np.cross(away, tangent)
    norm = np.linalg.norm(first, axis=1, keepdims=True)
    first = np.where(norm > 1e-6, first / np.maximum(norm, 1e-9), [0.0, 1.0, 0.0])
    second = np.cross(tangent, first)
    angles = np.pi / 2.0 + 2.0 * np.pi / sides * np.arange(sides)
    around = np.cos(angles)[:, None] * first[:, None] + np.sin(angles)[:, None] * second[:, None]
    vertices = (points[:, None] + radius * around).reshape(-1, 3)
    faces = []
    for k in range(sides):
        after = (k + 1) % sides
        faces += [[k, after, sides + k], [after, sides + after, sides + k]]
    return vertices, _repeated(faces, sides, len(points) - 1)


def thin(points: Array, most: int) -> Array:
    """At most that many of the points of a polyline, its ends among them, after repeated neighbours are left out."""
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > _APART
    kept: Array = points[np.concatenate([[True], apart])]
    return kept[np.unique(np.linspace(0, len(kept) - 1, most).round().astype(np.intp))]


def unit_disc(corners: int = 32) -> Mesh:
    """A level disc of radius 1 m around the origin."""
    angles = 2.0 * np.pi / corners * np.arange(corners)
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(corners)])
    index = np.arange(corners)
    faces = np.column_stack([np.zeros(corners), 1 + index, 1 + (index + 1) % corners]).astype(np.intp)
    return np.concatenate([np.zeros((1, 3)), rim]), faces


def ellipse_axes(covariance: Array, sigmas: float) -> tuple[float, float, float]:
    """Half axes [m] and direction of the longer one [rad] of a covariance (2, 2) [m^2] at some standard deviations."""
    variances, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    short, long = sigmas * np.sqrt(np.maximum(variances, 0.0))
    return float(long), float(short), math.atan2(vectors[1, 1], vectors[0, 1])


def _repeated(faces: list[list[int]], stride: int, count: int) -> IntArray:
    """The same faces ``count`` times, each time ``stride`` vertices on."""
    begin = stride * np.arange(count, dtype=np.intp)[:, None, None]
    return (begin + np.array(faces, dtype=np.intp)).reshape(-1, 3)
