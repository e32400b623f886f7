"""What one flight leaves behind; it can be stored in one file, so that a picture can be drawn again without flying."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from unifg.atomic_write import replacing
from unifg.errors import FileFormatError
from unifg.scenarios.log.columns import column, ragged, words
from unifg.scenarios.simulation.layouts import Layout
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["FlightLog", "LandmarkRow"]

_VERSION = 3


class LandmarkRow(NamedTuple):
    """Landmarks believed at one tick.

    Attributes:
        ids: (k,) names.
        means: (k, 2) positions [m].
        covariances: (k, 2, 2) [m^2].
        radii: (k,) [m]; 0 for corners.
    """

    ids: IntArray
    means: Array
    covariances: Array
    radii: Array

    @classmethod
    def of(cls, ids: ArrayLike, means: ArrayLike, covariances: ArrayLike, radii: ArrayLike) -> LandmarkRow:
        """A row of copies."""
        return cls(
            np.array(ids, dtype=np.intp).reshape(-1),
            np.array(means, dtype=np.float64).reshape(-1, 2),
            np.array(covariances, dtype=np.float64).reshape(-1, 2, 2),
            np.array(radii, dtype=np.float64).reshape(-1),
        )


@dataclass(kw_only=True)
class FlightLog:
    """One flight of T ticks with horizons of N steps among K moving obstacles.

    Row k holds what was true, believed and decided at ``time[k]``; ``controls[k]`` is held over ``[time[k], time[k] +
    dt]``. States are stored as position, quaternion (w, x, y, z), velocity. Parameters are ordered mass [kg], drag
    x, y, z [kg/s], wind x, y [m/s^2], updraft [m/s^2].

    Attributes:
        layout: start, target and what stands between.
        settings: everything that says how the flight was made (solver, coupling, seed, ...); JSON values.
        dt: control period [s].
        parameters_true: (7,).
        collisions: distinct contact events of the flight.
        reached: the target was reached.
        interrupted: the user stopped the flight before its end.
        outcome: what has become of the flight, in words.
        dropped: samples that were not let in, by what was wrong with them.
    """

    layout: Layout
    settings: dict[str, Any]
    dt: float
    parameters_true: Array
    collisions: int
    reached: bool
    interrupted: bool = False
    outcome: str = ""
    dropped: dict[str, int] = field(default_factory=dict)

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
    landmarks: list[LandmarkRow] = ragged("m", entry=lambda row: LandmarkRow.of(*row))
    """The map as believed."""
    parameters: Array = column("kg, kg/s, m/s^2", 7)
    """As believed."""
    parameters_sigma: Array = column("kg, kg/s, m/s^2", 7)
    seen: list[IntArray] = ragged(dtype=np.intp)
    """Ids the sensor reported."""
    movers: Array = column("m", None, 3)
    """Moving obstacles: x, y, radius."""
    estimate_ms: Array = column("ms")
    plan_ms: Array = column("ms")
    compiled: IntArray = column("functions", dtype=np.intp)
    """What was compiled, or read from the disk, in the tick: none, once the pilot has been woken."""
    statuses: list[str] = words()
    """Of the plan."""
    emergency: BoolArray = column(dtype=np.bool_)
    """True where no new plan was to be had and a stored one was flown."""
    clearance: Array = column("m")
    """Distance from the hull to the nearest obstacle or the floor."""
    health: list[str] = words()
    """What the supervisor makes of the vehicle: "ok", "degraded" or "lost"; "" without one."""
    causes: list[str] = words()
    """Why it is not well."""
    fault: list[str] = words()
    """What was made to go wrong just then."""

    @property
    def ticks(self) -> int:
        """Number of ticks recorded."""
        return len(self.truth)

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

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write everything to one compressed ``.npz`` file; lists of arrays are stored end to end."""
        arrays: dict[str, Any] = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}
        arrays |= {f"layout_{name}": getattr(self.layout, name) for name in _LAYOUT_ARRAYS}
        lists: dict[str, list[Any]] = {"pasts": self.pasts, "seen": self.seen}
        lists |= {f"landmarks_{name}": [getattr(row, name) for row in self.landmarks] for name in LandmarkRow._fields}
        for name, parts in lists.items():
            arrays[name] = np.concatenate([np.zeros((0, *_ROW_SHAPES[name])), *parts])
            arrays[f"{name}_lengths"] = np.array([len(part) for part in parts], dtype=np.int64)
        rest = {name: getattr(self, name) for name in _WORDS}
        rest |= {"version": _VERSION, "layout_name": self.layout.name}
        with replacing(path) as own, open(own, "wb") as file:  # numpy adds a suffix to a name, not to a file
            np.savez_compressed(file, words=np.array(json.dumps(rest)), **arrays)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> FlightLog:
        """Read a file written by :meth:`save`.

        Raises:
            FileFormatError: if the file is not a flight log, or of another version.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                stored = {name: file[name] for name in file.files}
            rest = json.loads(str(stored.pop("words")))
        except (KeyError, ValueError, EOFError) as error:
            raise FileFormatError(f"{os.fspath(path)} is not a flight log: {error}") from error
        if rest.pop("version", None) != _VERSION:
            raise FileFormatError(f"{os.fspath(path)} is a flight log of another version; this one reads {_VERSION}")
        lists: dict[str, list[Array]] = {}
        for name in _ROW_SHAPES:
            rows, ends = stored.pop(name), np.cumsum(stored.pop(f"{name}_lengths"))
            lists[name] = np.split(rows, ends[:-1]) if len(ends) else []
        rows_of = zip(*(lists.pop(f"landmarks_{name}") for name in LandmarkRow._fields), strict=True)
        layout = Layout(**{name: stored.pop(f"layout_{name}") for name in _LAYOUT_ARRAYS}, name=rest.pop("layout_name"))
        return FlightLog(
            layout=layout,
            landmarks=[LandmarkRow.of(*row) for row in rows_of],
            pasts=lists["pasts"],
            seen=[ids.astype(np.intp) for ids in lists["seen"]],
            **rest,
            **stored,
        )


_WORDS = (
    "settings",
    "dt",
    "statuses",
    "collisions",
    "reached",
    "interrupted",
    "health",
    "causes",
    "fault",
    "outcome",
    "dropped",
)
_LAYOUT_ARRAYS = ("start", "target", "cylinders", "walls", "size")
_ROW_SHAPES: dict[str, tuple[int, ...]] = {
    "pasts": (3,), "seen": (), "landmarks_ids": (), "landmarks_means": (2,), "landmarks_covariances": (2, 2),
    "landmarks_radii": (),
}  # fmt: skip
