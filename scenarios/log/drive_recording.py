"""Collects what each tick of an episode leaves behind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.typing import Array

if TYPE_CHECKING:
    from unifg.scenarios.driving.controller import Plan
    from unifg.scenarios.driving.pilot import Pilot
    from unifg.scenarios.seeing.readings import Scan
    from unifg.scenarios.seeing.tracks import Tracks
from unifg.scenarios.worlds.plane import World


class Recording:
    """Rows of an :class:`EpisodeLog` in the making.

    Attributes:
        reached: one flag per goal.
    """

    def __init__(self, world: World, goals: int) -> None:
        """Start empty."""
        self._world = world
        self._columns: dict[str, list[object]] = {}
        self._angles = np.zeros(world.lidar.beams)
        self.reached = [False] * goals

    def add(
        self,
        goal: int,
        pilot: Pilot,
        dead_reckoning: Array,
        scan: Scan,
        tracks: Tracks,
        plan: Plan,
        **milliseconds: float,
    ) -> None:
        """Record one tick."""
        world = self._world
        self._angles = scan.angles
        row: dict[str, object] = {
            "time": world.time,
            "true_pose": world.pose,
            "estimate": pilot.pose,
            "dead_reckoning": dead_reckoning,
            "control": plan.control,
            "horizon": plan.states,
            "scan": scan.ranges,
            "obstacles": world.obstacle_states()[:, :3],
            "detected": np.column_stack([tracks.centre, tracks.radius]),
            "localisation_iterations": pilot.iterations,
            "plan_iterations": plan.iterations,
            "status": plan.status.name.lower(),
            "bound_violation": plan.bound_violation,
            "clearance": world.clearance(),
            "goal_index": goal,
            "emergency": plan.emergency,
            "solve_ms": milliseconds["localise_ms"] + milliseconds["plan_ms"],
            **milliseconds,
        }
        for name, value in row.items():
            self._columns.setdefault(name, []).append(value)

    def log(self, interrupted: bool, **conditions: Any) -> EpisodeLog:
        """The finished record.

        Args:
            interrupted: whether the episode ended before its time.
            conditions: the fields of an :class:`EpisodeLog` that were known before the first tick.
        """
        columns = dict(self._columns)
        detected, status = columns.pop("detected"), columns.pop("status")
        arrays: dict[str, Any] = {name: np.array(values) for name, values in columns.items()}
        return EpisodeLog(
            scan_angles=self._angles,
            collisions=self._world.collisions,
            reached=self.reached,
            detected=detected,  # type: ignore[arg-type]
            status=status,  # type: ignore[arg-type]
            obstacle_moving=self._world.obstacle_states()[:, 3].astype(bool),
            interrupted=interrupted,
            **conditions,
            **arrays,
        )
