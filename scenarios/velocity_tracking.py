"""Velocity tracking: the forces that make a car follow a speed profile (ecg2o, section 5.1).

One optimal control problem over the whole drive, with the vehicle's dynamics as equalities:

    minimise  sum_{k=1}^{N-1} Q (v_k - vref_k)^2 + P (v_N - vref_N)^2 + sum_{k=0}^{N-1} R f_k^2
    subject to  v_{k+1} = v_k + dt / m_eq (f_k - resistance(v_k, slope_k)),  v_0 given

The guess is the paper's: speeds, forces and multipliers zero. The paper's J has no 1/2; ``Solution.cost`` is J / 2.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import unifg as fg
from unifg.models import vehicle
from unifg.models.vehicle import Vehicle
from unifg.scenarios.logs import metrics as numbers
from unifg.scenarios.options import Positive, Settings, count, existing, option, pair, positive
from unifg.scenarios.planning.speed_profile import Profile, drive_cycle, read_profile
from unifg.solution.solve_state import Callback
from unifg.solvers import names
from unifg.typing import Array

__all__ = [
    "Drive",
    "TrackingSettings",
    "metrics",
    "run_tracking",
    "state_problem",
    "table",
    "travelled",
]

ROUNDING = 1e-6  # relative, by which a limit may seem exceeded


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """Numbers of the problem.

    Attributes:
        length: steps N.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
        profile: CSV file of the speeds, column v_ref_mps [m/s]; without one, the drive cycle that ships with unifg.
        linear: air drag linear in the speed instead of quadratic.
        force_bounds: least and greatest force [N], if any.
        start: speed at the beginning [m/s].
        track: Q, weight of the deviation from the profile [s^2/m^2].
        end: P, the same at the last step.
        effort: R, weight of the force [1/N^2].
        vehicle: its parameters.
        tolerance: of the KKT test; penalty reaches 1e-5.
    """

    length: int = option(385, text=partial(count, least=1, most=100_000), metavar="N")
    solver: str = "kkt"
    profile: Path | None = option(None, text=existing("a CSV file with a column v_ref_mps"), metavar="F.csv")
    linear: bool = option(False)
    force_bounds: tuple[float, float] | None = option(None, text=pair, metavar="LO,HI")
    start: float = 0.0
    track: Positive[float] = 1000.0
    end: Positive[float] = 1000.0
    effort: Positive[float] = 0.0007
    vehicle: Vehicle = field(default_factory=Vehicle)
    tolerance: float = option(1e-6, text=positive, metavar="T")

    def speeds(self) -> Profile:
        """The profile to follow, N steps long.

        Raises:
            FileFormatError: the file is no profile.
            ScenarioError: the profile is too short.
        """
        whole = drive_cycle(self.length) if self.profile is None else read_profile(self.profile)
        return whole.first(self.length)


def state_problem(
    settings: TrackingSettings, profile: Profile, constrained: bool = True
) -> tuple[fg.Graph, fg.Family, fg.Family, fg.Guess]:
    """The control problem of a profile.

    Args:
        settings: the numbers.
        profile: the speeds to follow.
        constrained: False leaves out dynamics and bounds, to compare with the costs alone.

    Returns:
        The graph, speeds v (N + 1), forces f (N), and the guess of the paper: all zero after the start.
    """
    s, count = settings, len(profile.speed) - 1
    car = s.vehicle.linearised() if s.linear else s.vehicle
    graph = fg.Graph()
    v = graph.variables("speed", vehicle.SPEED, count + 1)
    f = graph.variables("force", vehicle.FORCE, count)
    graph.fix(v[0], [s.start])
    wanted = profile.speed[:, None]
    if count > 1:
        graph.minimize(fg.prior, v[1:-1], wanted[1:-1], sigma=s.track**-0.5, name="track")
    graph.minimize(fg.prior, v[-1], wanted[-1], sigma=s.end**-0.5, name="end")
    graph.minimize(fg.prior, f, [0.0], sigma=s.effort**-0.5, name="effort")
    if constrained:
        slope = profile.slope[:-1]
        model = vehicle.dynamics(car)
        graph.constrain(model, v[:-1], f, v[1:], profile.dt, slope, lower=0.0, upper=0.0, name="dynamics")
    if constrained and s.force_bounds is not None:
        graph.bound(f, lower=s.force_bounds[0], upper=s.force_bounds[1], name="force limits")
    speeds = np.zeros((count + 1, 1))
    speeds[0] = s.start
    return graph, v, f, fg.Guess({v: speeds, f: np.zeros((count, 1))})


@dataclass(frozen=True)
class Drive:
    """One solved problem.

    Attributes:
        settings: what was asked.
        profile: the speeds to follow.
        solution: with its history.
        speed: (N + 1,) [m/s].
        force: (N,) [N].
        multipliers: (N,) of the dynamics, for L = J / 2 + lambda' h.
    """

    settings: TrackingSettings
    profile: Profile
    solution: fg.Solution
    speed: Array
    force: Array
    multipliers: Array

    @property
    def cost(self) -> float:
        """The paper's J, without 1/2."""
        return 2.0 * float(self.solution.cost)

    @property
    def time(self) -> Array:
        """(N + 1,) [s]."""
        return self.profile.dt * np.arange(len(self.speed), dtype=np.float64)

    @property
    def error(self) -> Array:
        """(N + 1,) deviation from the profile [m/s]."""
        return self.speed - self.profile.speed

    @property
    def within_bounds(self) -> bool:
        """True if every force keeps its bounds."""
        bounds = self.settings.force_bounds
        if bounds is None:
            return True
        slack = ROUNDING * max(1.0, *map(abs, bounds))
        return bool(((self.force >= bounds[0] - slack) & (self.force <= bounds[1] + slack)).all())

    @property
    def succeeded(self) -> bool:
        """True if the solver converged and the bounds are kept."""
        return self.solution.converged and self.within_bounds


def run_tracking(settings: TrackingSettings | None = None, progress: Callback | None = None) -> Drive:
    """Solve one problem from the guess of the paper.

    Args:
        settings: None for the defaults.
        progress: called with every row of the history; returning True ends the solve.

    Raises:
        ScenarioError: for force bounds that leave nothing, or a profile that is too short.
        FileFormatError: when the file is no profile.
        BackendError: for an unknown solver, and when the solver cannot take force bounds.
    """
    s = settings or TrackingSettings()
    backend = names.backend(s.solver, tolerance=s.tolerance)
    if s.force_bounds is not None and not s.force_bounds[0] < s.force_bounds[1]:
        raise fg.ScenarioError(f"force bounds {s.force_bounds} leave nothing: the first must be below the second")
    profile = s.speeds()
    graph, v, f, guess = state_problem(s, profile)
    solution = backend.solve(graph, guess, callback=progress)
    return Drive(s, profile, solution, solution[v][:, 0], solution[f][:, 0], solution.dual("dynamics")[:, 0])


def travelled(speed: Array, dt: float) -> Array:
    """(N + 1,) way of speeds (N + 1,) that change evenly between samples [m]."""
    return dt * np.concatenate([[0.0], np.cumsum(0.5 * (speed[:-1] + speed[1:]))])


def metrics(drive: Drive) -> dict[str, Any]:
    """Numbers of a drive; ``cost`` is the paper's J, without 1/2; only ``solve_ms`` depends on the clock."""
    s, solution, bounds = drive.settings, drive.solution, drive.settings.force_bounds
    at_bound = 0
    if bounds is not None:
        at_bound = int((np.abs(solution.dual("force limits")) > 1e-6).sum())
    return {
        "scenario": "velocity-tracking",
        "profile": drive.profile.name,
        "length": len(drive.force),
        "drag": "linear" if s.linear else "quadratic",
        "force_bounds_n": None if bounds is None else [float(bounds[0]), float(bounds[1])],
        "solver": s.solver,
        **numbers.of_solution(solution),
        "within_bounds": drive.within_bounds,
        "cost": drive.cost,
        "rms_error_m_s": float(np.sqrt(np.mean(drive.error[1:] ** 2))),
        "max_error_m_s": float(np.abs(drive.error[1:]).max()),
        "min_force_n": float(drive.force.min()),
        "max_force_n": float(drive.force.max()),
        "forces_at_a_bound": at_bound,
    }


def table(drive: Drive) -> str:
    """The outcome for people."""
    m = metrics(drive)
    bounds = m["force_bounds_n"]
    rows = {
        "profile": f"{m['profile']}, {m['length']} steps of {drive.profile.dt:g} s",
        "drag": m["drag"],
        "solver": m["solver"],
        "status": m["status"].replace("_", " "),
        "iterations": f"{m['iterations']} in {m['solve_ms']:.1f} ms",
        "cost J (without 1/2)": f"{m['cost']:.6f}",
        "stationarity, violation": f"{m['stationarity']:.1e}, {m['violation']:.1e}",
        "speed off by": f"{m['rms_error_m_s']:.3f} m/s rms, {m['max_error_m_s']:.3f} m/s at most",
        "force": f"{m['min_force_n']:.1f} to {m['max_force_n']:.1f} N",
    }
    if bounds is not None:
        kept = "kept" if m["within_bounds"] else "BROKEN"
        rows["force limits"] = f"{bounds[0]:g} to {bounds[1]:g} N, {kept}, active {m['forces_at_a_bound']} times"
    return numbers.table(rows.items())
