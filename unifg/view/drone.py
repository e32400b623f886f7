"""Meshes of the quadrotor, as in `unifg.view.shapes`; of a vehicle of a radius [m], its nose along x."""

from __future__ import annotations

import numpy as np

from unifg.typing import Array
from unifg.view.shapes import Mesh, box, merge, ring, tube

__all__ = ["arms", "body", "nose", "rotors", "swept"]

_ROTOR, _LEVEL = 0.36, 0.17  # radius and height of the rotors over the radius of the vehicle
_ANGLES = np.pi / 4.0 + np.pi / 2.0 * np.arange(4)


def body(radius: float) -> Mesh:
    """The hull in the middle."""
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
