"""Bazzana's Table III (:mod:`unifg.scenarios.papers.control_instances`): the paper's loop and others beside IPOPT."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import numpy as np

from benchmarks.casadi_peer import Staged
from benchmarks.compiled_peers import COMPILER
from benchmarks.control_peers import unicycle_gap
from benchmarks.report import table
from benchmarks.runner import Timing
from benchmarks.timing import interleave, number
from unifg.models import potential
from unifg.scenarios.papers.control_instances import (
    CLEAR,
    DT,
    EFFORT,
    HULL,
    LIMIT,
    LOOP,
    PAPER,
    PATH,
    PUSH,
    SPEED,
    STEPS,
    STIFF,
    STOP,
    Instance,
    Ours,
    Outcome,
    bearings,
)
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint

MOST = 5000  # iterations of IPOPT
NEARLY = 0.02  # [m, m, rad] by which the start of a warm solve has moved
gap = partial(unicycle_gap, dt=DT)
"""Defect of the dynamics in symbols of casadi."""


def clearances(instance: Instance, x: Any) -> list[Any]:
    """Distances of the hull from the discs in symbols of casadi [m]."""
    import casadi as ca

    return [ca.norm_2(x[:2] - ca.DM([a, b])) - r - HULL for a, b, r in instance.discs]


class Casadi(Staged):
    """IPOPT on an instance, with derivatives of casadi."""

    def state(self, instance: Instance) -> None:
        """Build the program in the order u_0, x_1, u_1, ..., x_N."""
        import casadi as ca

        start, reference = ca.SX.sym("start", 3), instance.reference
        x = [start] + [ca.SX.sym(f"x{k}", 3) for k in range(1, STEPS + 1)]
        u = [ca.SX.sym(f"u{k}", 2) for k in range(STEPS)]
        cost: Any = 0.0
        rows: list[Any] = []
        equality: list[bool] = []
        for k in range(STEPS):
            defect = gap(x[k], u[k], x[k + 1])
            cost += ca.dot(EFFORT, (u[k] - ca.DM([SPEED, 0.0])) ** 2)
            cost += ca.dot(PATH, (x[k + 1] - ca.DM(reference[k + 1])) ** 2)
            clear = clearances(instance, x[k + 1])
            if instance.hard:
                rows += [defect, *(distance - CLEAR for distance in clear)]
                equality += [True] * 3 + [False] * len(clear)
            else:
                cost += STIFF * ca.sumsqr(defect)
                for distance in clear:
                    bounded = ca.fmin(ca.fmax(distance, potential.NEAR), potential.FAR)
                    cost += PUSH * (potential.SCALE * (1.0 / bounded - 1.0 / potential.FAR)) ** 2
        pairs = zip(u, x[1:], strict=True)
        unknowns = ca.vertcat(*(part for pair in pairs for part in pair))
        program = {"x": unknowns, "p": start, "f": 0.5 * cost, "g": ca.vertcat(*rows) if rows else ca.SX(0, 1)}
        free = np.tile([LIMIT, LIMIT, np.inf, np.inf, np.inf], STEPS)
        states, controls = instance.guess
        bounds: dict[str, Any] = {
            "lbx": -free,
            "ubx": free,
            "lbg": np.zeros(len(equality)),
            "ubg": np.where(equality, 0.0, np.inf),
        }
        self.build(program, x0=np.hstack([controls, states[1:]]).ravel(), p=instance.start, **bounds)

    @property
    def outcome(self) -> Outcome:
        """Of the last solve."""
        return self.status, 2.0 * self.cost, self.iterations

    def move(self, instance: Instance) -> None:
        """Take a moved start, with the last answer and its multipliers as the guess."""
        found = self.answer
        self.call |= {"p": instance.start, "x0": found["x"], "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}


Contestant: TypeAlias = Ours | Casadi
Makers: TypeAlias = dict[str, Callable[[], Contestant]]
WARM: dict[str, Any] = {
    "warm_start_init_point": "yes", "mu_init": 1e-6, "warm_start_bound_push": 1e-9, "warm_start_mult_bound_push": 1e-9,
    "warm_start_slack_bound_push": 1e-9, "warm_start_bound_frac": 1e-9, "warm_start_slack_bound_frac": 1e-9,
}  # fmt: skip
QUASI_NEWTON: dict[str, Any] = {"hessian_approximation": "limited-memory", "max_iter": MOST, "tol": STOP}


def contestants(hard: bool) -> Makers:
    """Contestants for one form of the problem, from the cold guess."""
    both: Makers = {
        "literal loop": lambda: Ours(AugmentedLagrangian(schedule="bazzana", **LOOP)),
        "literal loop, damped": lambda: Ours(AugmentedLagrangian(schedule="bazzana-damped", **LOOP)),
        "augmented Lagrangian": lambda: Ours(AugmentedLagrangian(tolerance=STOP)),
        "SQP": lambda: Ours(SQP(tolerance=STOP)),
        "interior point": lambda: Ours(InteriorPoint(tolerance=STOP)),
        "IPOPT as IFOPT calls it": lambda: Casadi(**QUASI_NEWTON),
        "IPOPT": lambda: Casadi(tol=STOP),
    }
    if COMPILER is not None:
        both["IPOPT, compiled"] = lambda: Casadi(compiled=True, tol=STOP)
    if hard:
        both["fatrop"] = lambda: Fatrop("fatrop", tol=STOP)
    return both


class Fatrop(Casadi):
    """Fatrop, which wants all states to be unknown and the first one held by a constraint."""

    def state(self, instance: Instance) -> None:
        """State it stage by stage."""
        import casadi as ca

        reference = instance.reference

        def stage(k: int, x: Any, u: Any) -> tuple[Any, list[Any], list[Any]]:
            zero = [x - ca.DM(instance.start)] if k == 0 else []
            cost = 0.5 * ca.dot(PATH, (x - ca.DM(reference[k])) ** 2) if k else ca.SX(0.0)
            if u is not None:
                cost += 0.5 * ca.dot(EFFORT, (u - ca.DM([SPEED, 0.0])) ** 2)
            return cost, zero, [distance - CLEAR for distance in clearances(instance, x)] if k else []

        free = np.array([np.inf, np.inf, np.inf, LIMIT, LIMIT])
        self.stages((3, 2, STEPS), stage, gap, ca.SX.sym("none", 0), (-free, free))
        self.begin(*instance.guess, np.zeros(0))


def cold(hard: bool, rounds: int) -> str:
    """A table of one form: every instance, every solver, all in one run and in turn."""
    lines = []
    ratios: dict[str, list[float]] = {}
    for row, bearing in zip(PAPER, bearings(), strict=True):
        instance = Instance(bearing, hard)
        running = {name: make() for name, make in contestants(hard).items()}
        for who in running.values():
            who.state(instance)
        seconds = interleave({name: who for name, who in running.items()}, rounds, warm=1, slow=1.0)
        taken = {name: 1e3 * float(np.median(some)) for name, some in seconds.items()}
        for name, who in running.items():
            how, cost, iterations = who.outcome
            ratios.setdefault(name, []).append(taken[name] / taken["augmented Lagrangian"])
            shown = f"{cost:.3f}" if cost < 1e6 else f"{cost:.0e}"
            lines.append([f"{row[0]:.2f}", name, how, shown, str(iterations), number(taken[name])])
        if not hard:
            for name, (final, count, took) in (("the paper's solver", row[1]), ("the paper's IPOPT", row[2])):
                lines.append([f"{row[0]:.2f}", name, "", f"{final:.3f}", str(count), f"{1e3 * took:.0f}"])
    median = ", ".join(f"{name} {number(float(np.median(values)), 2)}" for name, values in ratios.items())
    told = table(["initial cost", "solver", "ended", "final cost", "iterations", "time [ms]"], lines, 3)
    return f"{told}\n\nTime over that of the augmented Lagrangian, median of the six: {median}."


def warm(rounds: int) -> str:
    """Tick of a control loop: the start has moved, everything else is known."""
    kinds: Makers = {
        name: make
        for name, make in contestants(True).items()
        if name in ("augmented Lagrangian", "SQP", "interior point")
    }
    kinds["IPOPT, no warm start"] = lambda: Casadi(tol=STOP)
    kinds["IPOPT, warm"] = lambda: Casadi(tol=STOP, **WARM)
    if COMPILER is not None:
        kinds["IPOPT, warm, compiled"] = lambda: Casadi(compiled=True, tol=STOP, **WARM)
    found: dict[str, list[tuple[float, int]]] = {name: [] for name in kinds}
    for bearing in bearings():
        running = {name: make() for name, make in kinds.items()}
        for who in running.values():
            who.state(Instance(bearing, hard=True))
            who()
            who.move(Instance(bearing, True, NEARLY))
        seconds = interleave({name: who for name, who in running.items()}, rounds, warm=2)
        for name, who in running.items():
            found[name].append((1e3 * float(np.median(seconds[name])), who.outcome[2]))
    lines = [
        [name, number(float(np.median([took for took, _ in some]))), number(float(np.median([n for _, n in some])), 2)]
        for name, some in found.items()
    ]
    return table(["solver", "time [ms]", "iterations"], lines)


def report(rounds: int) -> str:
    """Everything as Markdown."""
    angles = ", ".join(f"{np.degrees(angle):.0f}" for angle in bearings())
    parts = [
        f"Six goals, {angles} degrees off the robot's heading. Costs are the paper's, without one half. Times are "
        f"processor times, medians over {rounds} rounds in which all solvers take turns.",
        "### His form",
        "Soft dynamics, potential field, bounds. The loops stop by his test, a step and violations below 1e-4, the "
        "others by a KKT test at 1e-4.",
        cold(False, rounds),
        "### Hard form",
        "Dynamics and clearance are constraints.",
        cold(True, rounds),
        "### A tick",
        f"The hard form again, from the last answer, the start {1e3 * NEARLY:.0f} mm beside where it was: medians over "
        "the six.",
        warm(rounds),
    ]
    return "\n\n".join(parts)


STUDY = Timing(report)
