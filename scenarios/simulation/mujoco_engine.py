"""MuJoCo (Todorov, Erez and Tassa, IROS 2012) as the truth: one vehicle on a floor among upright things.

Things of a scenario become geoms without an upper end; discs that move are carried along where the scenario moves them.
Everything the vehicle does, and everything that it touches, is the engine's.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import mujoco
import numpy as np

from unifg.scenarios.simulation.space import Space
from unifg.typing import Array, ArrayLike, IntArray

__all__ = ["STEP", "Engine", "box", "cylinder"]

STEP = 1e-3
"""Longest step of the engine [s]."""

SMOOTH = 0.2
"""Friction of geoms that state none: hulls along things."""

TALL = 20.0  # height of things [m]


def cylinder(x: float, y: float, radius: float) -> str:
    """Attributes of an upright cylinder [m]."""
    return f'type="cylinder" pos="{x!r} {y!r} {0.5 * TALL}" size="{radius!r} {0.5 * TALL}"'


def box(x: float, y: float, half_length: float, half_width: float, heading: float) -> str:
    """Attributes of an upright box about a centre [m], its length along a heading [rad]."""
    sides = f'size="{half_length!r} {half_width!r} {0.5 * TALL}"'
    return f'type="box" pos="{x!r} {y!r} {0.5 * TALL}" {sides} euler="0 0 {heading!r}"'


class Engine:
    """Model and state of the engine, and the contacts of the vehicle.

    Bits of contact: 1 is the floor, 2 are things; geoms of the vehicle have those in ``conaffinity`` that they meet.

    Attributes:
        model: of MuJoCo.
        data: of MuJoCo.
        touching: owners of what the vehicle touches.
    """

    def __init__(
        self,
        things: Sequence[tuple[int, str]],
        discs: Array,
        first: int,
        vehicle: str,
        rest: str,
        floor: tuple[int, float],
    ) -> None:
        """Build the model.

        Args:
            things: owner and attributes of what stands.
            discs: (K, 4) x, y, radius [m] of discs now, as `Space.discs` gives them.
            first: owner of the first disc; the next ones follow.
            vehicle: body of the name "vehicle", with a free joint.
            rest: actuators, sensors and assets.
            floor: its owner and height [m].
        """
        standing = "".join(f'<geom {geom} contype="2"/>' for _, geom in things)
        moving = "".join(
            f'<body mocap="true" pos="{x!r} {y!r} 0"><geom {cylinder(0.0, 0.0, radius)} contype="2"/></body>'
            for x, y, radius, _ in discs.tolist()
        )
        ground = f'type="plane" size="0 0 1" pos="0 0 {floor[1]}" condim="1" conaffinity="0"'
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><compiler angle="radian"/><default><geom friction="{SMOOTH} 0" conaffinity="0"/></default>'
            f'<option timestep="{STEP}" integrator="Euler" cone="elliptic" impratio="10"/>'
            f"<worldbody><geom {ground}/>{standing}{moving}{vehicle}</worldbody>{rest}</mujoco>"
        )
        self.data = mujoco.MjData(self.model)
        self.vehicle: int = self.model.body("vehicle").id
        self.touching: set[int] = set()
        self._owners = [floor[0], *(owner for owner, _ in things), *range(first, first + len(discs))]

    def place(self, position: ArrayLike, attitude: ArrayLike, velocity: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the vehicle at a position (3,) [m] in an attitude (4,), w first, with a velocity (3,) [m/s]."""
        self.data.qpos[:3], self.data.qpos[3:7], self.data.qvel[:] = position, attitude, 0.0
        self.data.qvel[:3] = velocity
        mujoco.mj_forward(self.model, self.data)

    def carry(self, discs: Array) -> None:
        """Carry the discs (K, 4) to where they are now [m]."""
        if len(discs):
            self.data.mocap_pos[:, :2] = discs[:, :2]

    def steps(self, pause: float) -> int:
        """Set the length of a step, `STEP` at most; how many of them make a pause [s]."""
        count = math.ceil(pause / STEP - 1e-9)
        self.model.opt.timestep = pause / count
        return count

    def step(self, count: int = 1) -> None:
        """Take steps with the actuators as they are told."""
        mujoco.mj_step(self.model, self.data, count)

    def report(self, space: Space, soft: Collection[int] = ()) -> None:
        """Tell a space which contacts have begun and ended; those of ``soft`` owners are no collisions."""
        now = {self._owners[geom] for geom in self.data.contact.geom.min(axis=1).tolist()}
        for owner in now - self.touching:
            space.begin(owner, owner not in soft)
        for owner in self.touching - now:
            space.separate(owner)
        self.touching = now

    def rays(self, origin: Sequence[float], ways: Array, reach: float) -> tuple[Array, IntArray]:
        """First things besides the vehicle that rays meet.

        Args:
            origin: (3,) [m].
            ways: (n, 3) unit vectors.
            reach: [m].

        Returns:
            (n,) distances [m], inf where nothing is in reach, and (n,) owners, which mean nothing there.
        """
        count = len(ways)
        geoms, found, start = np.zeros(count, dtype=np.int32), np.zeros(count), np.array(origin, dtype=np.float64)
        mujoco.mj_multiRay(
            self.model, self.data, start, ways.ravel(), None, True, self.vehicle, geoms, found, None, count, reach
        )
        owners = np.array(self._owners)[np.maximum(geoms, 0)]
        return np.where((geoms >= 0) & (found <= reach), found, np.inf), owners
