"""What one flight leaves behind: the record that metrics, plots and scenes read.

The loop writes it tick by tick; everything downstream only reads it. It can be stored in one file, so that a picture
can be drawn again without flying again.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from unifg.errors import FileFormatError
from unifg.scenarios.worlds.layouts import Layout
from unifg.typing import Array, ArrayLike, BoolArray, IntArray

__all__ = ["FlightLog", "FlightRecorder", "LandmarkRow"]

_VERSION = 1


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


@dataclass
class FlightLog:
    """One flight of T ticks with horizons of N steps among K moving obstacles.

    Row k holds what was true, believed and decided at ``time[k]``; ``controls[k]`` is held over ``[time[k], time[k] +
    dt]``. States are stored as position, quaternion (w, x, y, z), velocity. Parameters are ordered mass [kg], drag
    x, y, z [kg/s], wind x, y [m/s^2], updraft [m/s^2].

    Attributes:
        layout: start, target and what stands between.
        settings: everything that says how the flight was made (solver, coupling, seed, ...); JSON values.
        dt: control period [s].
        truth: (T, 10) states.
        believed: (T, 10) states.
        believed_sigma: (T, 9) standard deviations of the right perturbation (p, R, v) [m, rad, m/s].
        controls: (T, 4) body rates [rad/s] and thrust [N].
        plans: (T, N + 1, 3) predicted positions [m].
        pasts: T arrays (L_i, 3), positions of the estimator's window [m].
        landmarks: T maps as believed.
        parameters: (T, 7) believed.
        parameters_sigma: (T, 7).
        parameters_true: (7,).
        seen: T arrays of the ids the sensor reported.
        movers: (T, K, 3) x, y, radius of the moving obstacles [m].
        estimate_ms: (T,) [ms].
        plan_ms: (T,) [ms].
        statuses: T status words of the plan.
        emergency: (T,) True where no new plan was to be had and a stored one was flown.
        clearance: (T,) distance from the hull to the nearest obstacle or the floor [m].
        collisions: distinct contact events of the flight.
        reached: the target was reached.
        interrupted: the user stopped the flight before its end.
    """

    layout: Layout
    settings: dict[str, Any]
    dt: float
    truth: Array
    believed: Array
    believed_sigma: Array
    controls: Array
    plans: Array
    pasts: list[Array]
    landmarks: list[LandmarkRow]
    parameters: Array
    parameters_sigma: Array
    parameters_true: Array
    seen: list[IntArray]
    movers: Array
    estimate_ms: Array
    plan_ms: Array
    statuses: list[str]
    emergency: BoolArray
    clearance: Array
    collisions: int
    reached: bool
    interrupted: bool = False

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
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        arrays |= {f"layout_{name}": getattr(self.layout, name) for name in _LAYOUT_ARRAYS}
        ragged: dict[str, list[Array]] = {"pasts": self.pasts, "seen": [ids.astype(np.float64) for ids in self.seen]}
        for name in LandmarkRow._fields:
            ragged[f"landmarks_{name}"] = [np.asarray(getattr(row, name), dtype=np.float64) for row in self.landmarks]
        for name, parts in ragged.items():
            arrays[name] = np.concatenate(parts) if parts else np.zeros((0, *_ROW_SHAPES[name]))
            arrays[f"{name}_lengths"] = np.array([len(part) for part in parts], dtype=np.int64)
        words = {
            "version": _VERSION, "settings": self.settings, "dt": self.dt, "statuses": self.statuses,
            "collisions": self.collisions, "reached": self.reached, "interrupted": self.interrupted,
            "layout_name": self.layout.name,
        }  # fmt: skip
        with open(path, "wb") as file:  # numpy adds a suffix to a name, not to a file
            np.savez_compressed(file, allow_pickle=False, words=np.array(json.dumps(words)), **arrays)

    @staticmethod
    def load(path: str | os.PathLike[str]) -> FlightLog:
        """Read a file written by :meth:`save`.

        Raises:
            FileFormatError: if the file is not a flight log, or of another version.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                stored = {name: file[name] for name in file.files}
            words = json.loads(str(stored.pop("words")))
        except (KeyError, ValueError, EOFError) as error:
            raise FileFormatError(f"{os.fspath(path)} is not a flight log: {error}") from error
        if words.pop("version", None) != _VERSION:
            raise FileFormatError(f"{os.fspath(path)} is a flight log of another version; this one reads {_VERSION}")
        ragged = {name: np.split(stored[name], np.cumsum(stored[f"{name}_lengths"])[:-1]) for name in _ROW_SHAPES}
        for name in _ROW_SHAPES:
            if len(stored[f"{name}_lengths"]) == 0:
                ragged[name] = []
        columns = [ragged[f"landmarks_{name}"] for name in LandmarkRow._fields]
        rows = [
            LandmarkRow(ids.astype(np.intp), means, covariances, radii)
            for ids, means, covariances, radii in zip(*columns, strict=True)
        ]
        layout = Layout(**{name: stored[f"layout_{name}"] for name in _LAYOUT_ARRAYS}, name=words.pop("layout_name"))
        seen = [ids.astype(np.intp) for ids in ragged["seen"]]
        arrays = {name: stored[name] for name in _ARRAYS}
        return FlightLog(layout=layout, pasts=ragged["pasts"], landmarks=rows, seen=seen, **words, **arrays)


_ARRAYS = (
    "truth", "believed", "believed_sigma", "controls", "plans", "parameters", "parameters_sigma", "parameters_true",
    "movers", "estimate_ms", "plan_ms", "emergency", "clearance",
)  # fmt: skip
_LAYOUT_ARRAYS = ("start", "target", "cylinders", "walls", "size")
_ROW_SHAPES: dict[str, tuple[int, ...]] = {
    "pasts": (3,), "seen": (), "landmarks_ids": (), "landmarks_means": (2,), "landmarks_covariances": (2, 2),
    "landmarks_radii": (),
}  # fmt: skip
_COLUMNS: dict[str, tuple[int, ...]] = {
    "truth": (10,), "believed": (10,), "believed_sigma": (9,), "controls": (4,), "parameters": (7,),
    "parameters_sigma": (7,), "estimate_ms": (), "plan_ms": (), "clearance": (),
}  # fmt: skip


class FlightRecorder:
    """A flight log in the making: one :meth:`add` per tick, then :meth:`finish`."""

    def __init__(self, layout: Layout, settings: dict[str, Any], dt: float, parameters_true: ArrayLike) -> None:
        """Start empty.

        Args:
            layout: of the flight.
            settings: JSON values that say how the flight is made.
            dt: control period [s].
            parameters_true: (7,) mass, drag, wind, updraft.
        """
        self._layout, self._settings, self._dt = layout, dict(settings), float(dt)
        self._parameters_true = np.array(parameters_true, dtype=np.float64)
        self._columns: dict[str, list[Array]] = {name: [] for name in _COLUMNS}
        self._plans: list[Array] = []
        self._movers: list[Array] = []
        self._pasts: list[Array] = []
        self._landmarks: list[LandmarkRow] = []
        self._seen: list[IntArray] = []
        self._statuses: list[str] = []
        self._emergency: list[bool] = []

    def add(
        self,
        *,
        truth: ArrayLike,
        believed: ArrayLike,
        believed_sigma: ArrayLike,
        control: ArrayLike,
        plan: ArrayLike,
        past: ArrayLike,
        landmarks: tuple[ArrayLike, ArrayLike, ArrayLike, ArrayLike],
        parameters: ArrayLike,
        parameters_sigma: ArrayLike,
        seen: ArrayLike,
        movers: ArrayLike,
        estimate_ms: float,
        plan_ms: float,
        status: str,
        clearance: float,
        emergency: bool = False,
    ) -> None:
        """Record one tick; copies what it is given. Fields as in :class:`FlightLog`, without the time axis."""
        row = {
            "truth": truth, "believed": believed, "believed_sigma": believed_sigma, "controls": control,
            "parameters": parameters, "parameters_sigma": parameters_sigma, "estimate_ms": estimate_ms,
            "plan_ms": plan_ms, "clearance": clearance,
        }  # fmt: skip
        for name, value in row.items():
            self._columns[name].append(np.array(value, dtype=np.float64).reshape(_COLUMNS[name]))
        self._plans.append(np.array(plan, dtype=np.float64).reshape(-1, 3))
        self._movers.append(np.array(movers, dtype=np.float64).reshape(-1, 3))
        self._pasts.append(np.array(past, dtype=np.float64).reshape(-1, 3))
        ids, means, covariances, radii = landmarks
        self._landmarks.append(
            LandmarkRow(
                np.array(ids, dtype=np.intp).reshape(-1),
                np.array(means, dtype=np.float64).reshape(-1, 2),
                np.array(covariances, dtype=np.float64).reshape(-1, 2, 2),
                np.array(radii, dtype=np.float64).reshape(-1),
            )
        )
        self._seen.append(np.array(seen, dtype=np.intp).reshape(-1))
        self._statuses.append(status)
        self._emergency.append(bool(emergency))

    def finish(self, *, collisions: int, reached: bool, interrupted: bool = False) -> FlightLog:
        """The finished record; also that of a flight without ticks."""
        empty = not self._plans
        columns = {
            name: np.array(rows, dtype=np.float64).reshape(-1, *_COLUMNS[name]) for name, rows in self._columns.items()
        }
        return FlightLog(
            layout=self._layout,
            settings=self._settings,
            dt=self._dt,
            plans=np.zeros((0, 1, 3)) if empty else np.stack(self._plans),
            pasts=self._pasts,
            landmarks=self._landmarks,
            parameters_true=self._parameters_true,
            seen=self._seen,
            movers=np.zeros((0, 0, 3)) if empty else np.stack(self._movers),
            statuses=self._statuses,
            emergency=np.array(self._emergency, dtype=bool),
            collisions=int(collisions),
            reached=bool(reached),
            interrupted=interrupted,
            **columns,
        )
