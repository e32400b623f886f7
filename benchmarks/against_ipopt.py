"""Bazzana's Table III: one instance of the control problem after the other, his loop and others beside IPOPT.

The paper gives six initial costs, six final ones, iterations and times, and neither goals nor weights, horizon, map or
guess. What is known is kept: the costs of eq. 8 to 11 (soft dynamics, potential field with his k, mu, rho), limits of
1, his stop test, a guess along a straight path. Such a guess fits every cost but the first step of the dynamics, where
the robot faces elsewhere, so that an initial cost is in effect a bearing of the goal: here it is chosen so that each
initial cost is the paper's. The hard form has the dynamics and the clearance as constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import brentq

import unifg as fg
from benchmarks.compiled_peers import COMPILER
from benchmarks.compiled_peers import compiled as in_machine_code
from benchmarks.control_peers import unicycle_gap
from benchmarks.printed import numbers
from benchmarks.report import table, words
from benchmarks.runner import Timing
from benchmarks.timing import clocked, interleave, number
from unifg.models import obstacles, potential, unicycle
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.typing import Array

Row: TypeAlias = tuple[float, tuple[float, int, float], tuple[float, int, float]]


def _rows() -> tuple[Row, ...]:
    """The paper's: initial cost; final cost, iterations and seconds of its solver; the same of IPOPT."""
    of = partial(numbers, "bazzana", "Table III")
    found = list(zip(of("final_cost"), map(int, of("iterations")), of("time"), strict=True))
    return tuple(zip(of("initial_cost"), found[::2], found[1::2], strict=True))


PAPER = _rows()
STEPS, DT, SPEED, HULL, CLEAR = 30, 0.1, 0.5, 0.17, 0.03
PATH, EFFORT, STIFF, PUSH = np.array([10.0, 10.0, 1.0]), np.array([0.1, 0.1]), 3000.0, 20.0
LIMIT = 1.0
ASIDE = ((0.45, 0.75, 0.25), (1.05, -0.7, 0.2))  # along and across the path, radius of two discs [m]
STOP = 1e-4
RHO = 1000.0  # of the loops with a constant one: of the powers of ten, the damped loop does best with it
MOST = 5000  # iterations of IPOPT
NEARLY = 0.02  # [m, m, rad] by which the start of a warm solve has moved
Outcome: TypeAlias = tuple[str, float, int]
"""How it ended, cost, iterations."""


@dataclass(frozen=True)
class Instance:
    """One control problem.

    Attributes:
        bearing: of the goal, from the robot's heading [rad].
        hard: dynamics and clearance are constraints, and there is no potential.
        moved: by how much the start has moved since the problem was solved before, sideways [m].
    """

    bearing: float
    hard: bool = False
    moved: float = 0.0

    @property
    def start(self) -> Array:
        """(3,) pose of the robot."""
        return np.array([0.0, self.moved, 0.0])

    @property
    def reference(self) -> Array:
        """(N + 1, 3) along the path; headings are not wrapped."""
        way = SPEED * DT * np.arange(STEPS + 1.0)
        b = self.bearing
        return np.column_stack([way * np.cos(b), way * np.sin(b), np.full(len(way), b)])

    @property
    def discs(self) -> Array:
        """(M, 3) beside the path: x, y, radius [m]."""
        c, s = np.cos(self.bearing), np.sin(self.bearing)
        return np.array([(c * a - s * b, s * a + c * b, r) for a, b, r in ASIDE])

    @property
    def guess(self) -> tuple[Array, Array]:
        """Poses and controls of the path itself, after the true start."""
        states = self.reference
        states[0] = self.start
        return states, np.tile([SPEED, 0.0], (STEPS, 1))

    def stated(self) -> tuple[fg.Graph, fg.Family, fg.Family, fg.Guess]:
        """As a factor graph, whose cost is half of the paper's."""
        states, controls = self.guess
        graph = fg.Graph()
        x = graph.variables("pose", fg.SE2, STEPS + 1)
        u = graph.variables("control", fg.Rn(2), STEPS)
        graph.fix(x[0], self.start)
        wrapped = np.column_stack([self.reference[:, :2], np.angle(np.exp(1j * self.reference[:, 2]))])
        graph.minimize(unicycle.tracking, x[1:], wrapped[1:], information=np.diag(PATH), name="path")
        graph.minimize(fg.prior, u, controls[0], information=np.diag(EFFORT), name="effort")
        centres, radii = self.discs[:, :2], self.discs[:, 2] + HULL
        steps = x[:-1], u, x[1:], DT
        if self.hard:
            graph.constrain(unicycle.dynamics, *steps, lower=0.0, upper=0.0, name="dynamics")
            graph.constrain(obstacles.disc_clearance, x[1:], centres, radii, lower=CLEAR, name="discs")
        else:
            graph.minimize(unicycle.dynamics, *steps, information=STIFF * np.eye(3), name="dynamics")
            push = potential.potential(obstacles.disc_clearance)
            graph.minimize(push, x[1:], centres, radii, sigma=PUSH**-0.5, name="potential")
        graph.bound(u, lower=-LIMIT, upper=LIMIT, name="limits")
        return (
            graph,
            x,
            u,
            fg.Guess({x: np.column_stack([states[:, :2], np.angle(np.exp(1j * states[:, 2]))]), u: controls}),
        )


@cache
def bearings() -> tuple[float, ...]:
    """Of the goals whose guesses cost what the paper's cost."""

    def excess(bearing: float, wanted: float) -> float:
        instance = Instance(bearing)
        x, u = instance.guess
        defect = unicycle.dynamics(x[:-1], u, x[1:], DT)
        push = potential.potential(obstacles.disc_clearance)(x[1:], instance.discs[:, :2], instance.discs[:, 2] + HULL)
        return STIFF * float((defect**2).sum()) + PUSH * float((push**2).sum()) - wanted

    return tuple(float(brentq(excess, 0.3, np.pi - 1e-6, args=(row[0],))) for row in PAPER)


class Ours:
    """A backend of unifg on an instance."""

    def __init__(self, solver: fg.Solver) -> None:
        """Take a backend."""
        self.solver = solver

    def state(self, instance: Instance) -> None:
        """Prepare."""
        graph, self.x, self.u, self.guess = instance.stated()
        self.run = self.solver.prepare(graph)

    def __call__(self) -> float:
        """Solve from the guess; processor time [s]."""
        self.solution, spent = clocked(self.run.solve, self.guess)
        return spent

    @property
    def outcome(self) -> Outcome:
        """Of the last solve."""
        return words(self.solution.status), 2.0 * self.solution.cost, self.solution.iterations

    def move(self, instance: Instance) -> None:
        """Prepare a moved instance, with the last answer as its guess."""
        states, controls = self.solution[self.x], self.solution[self.u]
        self.state(instance)
        self.guess = fg.Guess({self.x: states, self.u: controls})


gap = partial(unicycle_gap, dt=DT)
"""Defect of the dynamics in symbols of casadi."""


def clearances(instance: Instance, x: Any) -> list[Any]:
    """Distances of the hull from the discs in symbols of casadi [m]."""
    import casadi as ca

    return [ca.norm_2(x[:2] - ca.DM([a, b])) - r - HULL for a, b, r in instance.discs]


class Casadi:
    """IPOPT or fatrop on an instance, with derivatives of casadi."""

    def __init__(self, plugin: str = "ipopt", compiled: bool = False, **options: Any) -> None:
        """Take a solver, its options, and whether functions are compiled."""
        self.plugin, self.compiled, self.options = plugin, compiled, options

    def state(self, instance: Instance) -> None:
        """Build the program in the order u_0, x_1, u_1, ..., x_N; fatrop sees its stages from it."""
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
        chosen: dict[str, Any] = {"print_time": False, self.plugin: {"print_level": 0, **self.options}}
        chosen[self.plugin] |= {"sb": "yes"}
        solver = ca.nlpsol("solver", self.plugin, program, chosen)
        self.solver: Any = in_machine_code(solver, self.plugin, chosen) if self.compiled else solver
        free = np.tile([LIMIT, LIMIT, np.inf, np.inf, np.inf], STEPS)
        states, controls = instance.guess
        self.call: dict[str, Any] = {
            "x0": np.hstack([controls, states[1:]]).ravel(), "p": instance.start, "lbx": -free, "ubx": free,
            "lbg": np.zeros(len(equality)), "ubg": np.where(equality, 0.0, np.inf) if equality else np.zeros(0),
        }  # fmt: skip

    def __call__(self) -> float:
        """Solve from the guess; processor time [s]."""
        self.found, spent = clocked(self.solver, **self.call)
        return spent

    @property
    def outcome(self) -> Outcome:
        """Of the last solve."""
        stats = self.solver.stats()
        how = "converged" if stats["success"] else str(stats.get("return_status", "failed")).replace("_", " ").lower()
        return how, 2.0 * float(self.found["f"]), int(stats["iter_count"])

    def move(self, instance: Instance) -> None:
        """Take a moved start, with the last answer and its multipliers as the guess."""
        found = self.found
        self.call |= {"p": instance.start, "x0": found["x"], "lam_x0": found["lam_x"], "lam_g0": found["lam_g"]}


Contestant: TypeAlias = Ours | Casadi
LOOP: dict[str, Any] = {"penalty": RHO, "step_tolerance": STOP, "tolerance": 1e-18, "max_iterations": 1000}
WARM: dict[str, Any] = {
    "warm_start_init_point": "yes", "mu_init": 1e-6, "warm_start_bound_push": 1e-9, "warm_start_mult_bound_push": 1e-9,
    "warm_start_slack_bound_push": 1e-9, "warm_start_bound_frac": 1e-9, "warm_start_slack_bound_frac": 1e-9,
}  # fmt: skip
QUASI_NEWTON: dict[str, Any] = {"hessian_approximation": "limited-memory", "max_iter": MOST, "tol": STOP}


def contestants(hard: bool) -> dict[str, Callable[[], Contestant]]:
    """Contestants for one form of the problem, from the cold guess."""
    both: dict[str, Callable[[], Contestant]] = {
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
        both["fatrop"] = lambda: Fatrop()
    return both


class Fatrop(Casadi):
    """Fatrop, which wants all states to be unknown and the first one held by a constraint."""

    def __init__(self) -> None:
        """Take its tolerance."""
        super().__init__("fatrop", tol=STOP)

    def state(self, instance: Instance) -> None:
        """State it stage by stage."""
        import casadi as ca

        from benchmarks.casadi_peer import Staged

        reference = instance.reference

        def stage(k: int, x: Any, u: Any) -> tuple[Any, list[Any], list[Any]]:
            zero = [x - ca.DM(instance.start)] if k == 0 else []
            cost = 0.5 * ca.dot(PATH, (x - ca.DM(reference[k])) ** 2) if k else ca.SX(0.0)
            if u is not None:
                cost += 0.5 * ca.dot(EFFORT, (u - ca.DM([SPEED, 0.0])) ** 2)
            return cost, zero, [distance - CLEAR for distance in clearances(instance, x)] if k else []

        free = np.array([np.inf, np.inf, np.inf, LIMIT, LIMIT])
        self.staged = Staged("fatrop", (3, 2, STEPS), stage, gap, ca.SX.sym("none", 0), (-free, free), tol=STOP)
        self.guessed = instance.guess

    def __call__(self) -> float:
        """Solve from the guess; processor time [s]."""
        return 1e-3 * self.staged.run(*self.guessed, np.zeros(0))

    @property
    def outcome(self) -> Outcome:
        """Of the last solve."""
        return self.staged.status, 2.0 * self.staged.cost, self.staged.iterations


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
    kinds: dict[str, Callable[[], Contestant]] = {
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
