"""Columns and numbers that logs of drives and flights share."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from unifg.scenarios.logs.columns import column, words
from unifg.scenarios.logs.stored import StoredLog
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["VehicleLog"]


@dataclass(kw_only=True, eq=False)
class VehicleLog(StoredLog):
    """A run of T ticks of one vehicle.

    Attributes:
        dt: control period [s].
        collisions: distinct contact events.
        interrupted: the user stopped the run before its end.
        dropped: samples that were not let in, by what was wrong with them.
        subproblems: quadratic programs of plans by the solver that solved them; empty for backends without any.
    """

    dt: float
    collisions: int
    interrupted: bool = False
    dropped: dict[str, int] = field(default_factory=dict)
    subproblems: dict[str, int] = field(default_factory=dict)

    plan_ms: Array = column("ms")
    compiled: IntArray = column("functions", dtype=np.intp)
    """Functions compiled, or read from the disk, in the tick: none, once the pilot has been woken."""
    clearance: Array = column("m")
    """Distance from the hull to the nearest thing, of a flight also to the floor."""
    emergency: BoolArray = column(dtype=np.bool_)
    """True where there was no new plan: a stored one was followed, or the vehicle braked or got out of the way."""
    health: list[str] = words()
    """State by the supervisor: "ok", "degraded" or "lost"; "" without one."""
    fault: list[str] = words()
    """Injected fault of the tick."""
