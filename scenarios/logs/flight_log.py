"""Log of a flight, from which pictures are drawn again without flying."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from unifg.scenarios.logs.columns import column, ragged, words
from unifg.scenarios.logs.vehicle_log import VehicleLog
from unifg.scenarios.simulation.layouts import Layout
from unifg.typing import Array, ArrayLike, IntArray

__all__ = ["LANDMARK", "FlightLog", "landmark_rows"]

LANDMARK = np.dtype([("id", np.intp), ("mean", float, 2), ("covariance", float, (2, 2)), ("radius", float)])
"""A landmark as believed: name, position [m], covariance [m^2], radius [m], zero for corners."""


def landmark_rows(ids: ArrayLike, means: ArrayLike, covariances: ArrayLike, radii: ArrayLike) -> Any:
    """(k,) rows of type `LANDMARK` from columns (k,), (k, 2), (k, 2, 2), (k,)."""
    rows = np.zeros(len(np.asarray(ids)), dtype=LANDMARK)
    rows["id"], rows["mean"], rows["covariance"], rows["radius"] = ids, means, covariances, radii
    return rows


@dataclass(kw_only=True, eq=False)
class FlightLog(VehicleLog):
    """One flight of T ticks with horizons of N steps among K moving obstacles.

    Row k holds what was true, believed and decided at ``time[k]``; ``controls[k]`` is held over ``[time[k], time[k] +
    dt]``. States are stored as position, quaternion (w, x, y, z), velocity. Parameters are ordered mass [kg], drag
    x, y, z [kg/s], wind x, y [m/s^2], updraft [m/s^2].

    Attributes:
        layout: start, target and what stands between.
        settings: everything that says how the flight was made (solver, coupling, seed, ...); JSON values.
        reached: the target was reached.
        outcome: of the flight, in words.
    """

    KIND: ClassVar[str] = "unifg flight log 5"

    layout: Layout
    settings: dict[str, Any]
    reached: bool
    outcome: str = ""

    truth: Array = column("m, 1, m/s", 10)
    believed: Array = column("m, 1, m/s", 10)
    believed_sigma: Array = column("m, rad, m/s", 9)
    """Standard deviations of the right perturbation (p, R, v)."""
    controls: Array = column("rad/s, N", 4)
    """Body rates and thrust."""
    plans: Array = column("m", None, 3)
    """Predicted positions."""
    pasts: list[Array] = ragged("m", 3)
    """Positions of the estimator's window."""
    landmarks: list[Any] = ragged("m, m^2", dtype=LANDMARK)
    """The map as believed, rows of type `LANDMARK`."""
    parameters: Array = column("kg, kg/s, m/s^2", 7)
    """As believed."""
    parameters_sigma: Array = column("kg, kg/s, m/s^2", 7)
    parameters_true: Array = column("kg, kg/s, m/s^2", 7)
    """Those of the step that led here, with the load and the wind of injected faults."""
    seen: list[IntArray] = ragged(dtype=np.intp)
    """Ids the sensor reported."""
    movers: Array = column("m", None, 3)
    """Moving obstacles: x, y, radius."""
    estimate_ms: Array = column("ms")
    statuses: list[str] = words()
    """Of the plan."""
    causes: list[str] = words()
    """Cause of a state that is not "ok"."""

    @property
    def time(self) -> Array:
        """(T,) since the start [s]."""
        return self.dt * np.arange(self.ticks, dtype=np.float64)

    @property
    def target_distance(self) -> Array:
        """(T,) distance from the true position to the target [m]."""
        distance: Array = np.linalg.norm(self.truth[:, :3] - self.layout.target, axis=1)
        return distance

    @property
    def succeeded(self) -> bool:
        """The target was reached without a collision."""
        return self.reached and self.collisions == 0 and not self.interrupted
