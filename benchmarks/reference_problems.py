"""Sixteen optimal control problems of a unicycle with known optima, solved cold by the constrained backends.

    python -m benchmarks.reference_problems [--rounds R]

minimise   sum_k 1/2 |x_k - xr_k|_W^2 + 1/2 |u_k - ur_k|_Wu^2  (+ 1/2 |x_N - xr_N|_WN^2)
subject to x_0 given, x_{k+1} = f(x_k, u_k), |u| <= 1, and five discs to be avoided at every node.

The listed optima were found by IPOPT 3.14 at tolerance 1e-9 from the same guess. With discs there are several local
optima, one for each choice of side, so a lower cost is another optimum and not a mistake. If casadi is installed, its
IPOPT (MUMPS) and fatrop, both with exact Hessians, solve the same problems in turn with ours, for the times, and IPOPT
starts from every answer of ours that is in no list, to see whether it is an optimum. The same solvers then drive the
robot for a hundred steps (:mod:`benchmarks.closed_loop`). Writes docs/reference-problems.md.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import ClassVar

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks import closed_loop
from benchmarks.closed_loop import Formulation, Peer
from benchmarks.report import CHECKOUT, OUT, machine, put_results, table
from unifg.models import unicycle
from unifg.solvers import SQP, AugmentedLagrangian, InteriorPoint
from unifg.typing import Array

DT = 0.1  # [s]
LIMIT = 1.0  # [m/s] and [rad/s]
STAGE, TERMINAL, EFFORT = np.array([10.0, 10.0, 1.0]), np.array([50.0, 50.0, 5.0]), np.array([0.1, 0.1])
HORIZONS = (20, 50)
SAME = 1e-5  # relative difference below which two costs count as one optimum
STAYS = 1e-6  # and below which IPOPT has stayed where it was started
GOOD = 1e-4  # KKT numbers below which a problem counts as solved
SLOW = 2000.0  # [ms]; a slower solve is not repeated
PEERS = ("ipopt", "fatrop")
ALONE = "sqp, OSQP alone"  # needs no success for the exit code: it shows what the fallback is for

STARTS = {
    "straight": (0.0, 0.5, -0.4),
    "curve": (0.0, -0.4, 0.6),
    "ahead": (0.0, 0.0, 0.0),
    "behind": (0.0, 0.0, 0.3),
}
RING = ((0.6, 2.2), (1.3, 1.8), (2.2, 2.2), (3.2, 1.8), (4.2, 2.2))  # angle [rad] and distance [m] from (0, 2)
DISCS = {  # x, y, radius [m]
    "straight": ((1.6, -0.15, 0.4), (3.0, 0.25, 0.45), (5.0, -0.2, 0.5), (6.6, 0.3, 0.4), (8.2, -0.25, 0.4)),
    "curve": tuple((d * np.sin(a), 2.0 - d * np.cos(a), 0.35) for a, d in RING),
    "ahead": ((1.2, 0.55, 0.4), (2.1, 0.4, 0.35), (0.6, -0.5, 0.3), (3.6, 1.5, 0.3), (2.0, 1.6, 0.3)),
    "behind": ((-1.0, 0.25, 0.3), (-1.9, -0.2, 0.3), (0.7, 0.6, 0.3), (-0.4, -0.8, 0.3), (-3.0, 0.15, 0.3)),
}
# (instance, with discs, N): known local optima, the one reached by IPOPT from the cold guess first.
OPTIMA: dict[tuple[str, bool, int], tuple[float, ...]] = {
    ("straight", False, 20): (6.40874,),
    ("straight", False, 50): (6.40879,),
    ("straight", True, 20): (9.56973,),
    ("straight", True, 50): (12.98617,),
    ("curve", False, 20): (3.74998,),
    ("curve", False, 50): (3.74998,),
    ("curve", True, 20): (5.32781, 5.33182),
    ("curve", True, 50): (6.91008,),
    ("ahead", False, 20): (561.41452,),
    ("ahead", False, 50): (558.59179,),
    ("ahead", True, 20): (579.75063,),
    ("ahead", True, 50): (608.83744,),
    ("behind", False, 20): (54.47372,),
    ("behind", False, 50): (59.47520,),
    ("behind", True, 20): (54.47522,),
    ("behind", True, 50): (63.46789, 63.46577, 79.43),
}


@dataclass(frozen=True)
class Problem:
    """The numbers of one problem.

    Attributes:
        instance: name.
        blocked: whether the discs are there.
        horizon: N.
        dt: sampling time [s].
        limit: of both controls [m/s, rad/s].
    """

    dt: ClassVar[float] = DT
    limit: ClassVar[float] = LIMIT

    instance: str
    blocked: bool
    horizon: int

    @property
    def name(self) -> str:
        """For the tables."""
        return f"{self.instance}{', discs' if self.blocked else ''}, N = {self.horizon}"

    @property
    def optima(self) -> tuple[float, ...]:
        """Known optima."""
        return OPTIMA[self.instance, self.blocked, self.horizon]

    @property
    def discs(self) -> Array:
        """(M, 3) x, y, radius [m]."""
        return np.array(DISCS[self.instance] if self.blocked else np.zeros((0, 3)), dtype=np.float64)

    @property
    def start(self) -> Array:
        """(3,) first pose."""
        return np.array(STARTS[self.instance])

    @property
    def weights(self) -> tuple[Array, Array]:
        """Of the states (N + 1, 3) and of a control (2,)."""
        return np.vstack([np.tile(STAGE, (self.horizon, 1)), TERMINAL]), EFFORT

    def reference(self, first: int = 0) -> tuple[Array, Array]:
        """Reference states (N + 1, 3) from step ``first`` on, headings not wrapped, and controls (N, 2)."""
        t = DT * np.arange(first, first + self.horizon + 1)
        zero = np.zeros_like(t)
        states, control = {
            "straight": ((0.8 * t, zero, zero), (0.8, 0.0)),
            "curve": ((2.0 * np.sin(0.35 * t), 2.0 - 2.0 * np.cos(0.35 * t), 0.35 * t), (0.7, 0.35)),
            "ahead": ((zero + 3.0, zero + 1.0, zero), (0.0, 0.0)),
            "behind": ((-0.5 * t, zero, zero + np.pi), (0.5, 0.0)),
        }[self.instance]
        return np.column_stack(states), np.tile(control, (self.horizon, 1))

    def guess(self) -> tuple[Array, Array]:
        """The reference itself, even through the discs; ``ahead`` has none and begins with the robot at rest."""
        states, controls = self.reference()
        if self.instance == "ahead":
            states[:] = STARTS["ahead"]
        states[0] = STARTS[self.instance]
        return states, controls

    def plant(self, pose: Array, control: Array, index: int) -> Array:
        """(3,) pose after closed-loop step ``index``, heading not wrapped; disturbed only where no disc can be hit."""
        moved = unicycle.step(pose[None], control[None], DT)[0]
        moved[2] = pose[2] + DT * control[1]
        push = 0.01 * np.array([np.sin(1.7 * index), np.cos(2.3 * index), np.sin(3.1 * index)])
        return np.asarray(moved if self.blocked else moved + push)

    def stage_cost(self, pose: Array, control: Array, index: int) -> float:
        """Cost of one step of the closed loop."""
        states, controls = self.reference(index)
        return float(0.5 * STAGE @ (pose - states[0]) ** 2 + 0.5 * EFFORT @ (control - controls[0]) ** 2)


def problems() -> list[Problem]:
    """All sixteen."""
    return [Problem(*numbers) for numbers in itertools.product(STARTS, (False, True), HORIZONS)]


@dataclass
class Outcome:
    """What one solver made of one problem.

    Attributes:
        status: in words.
        iterations: of the solver.
        cost: with its 1/2.
        routes: how many subproblems each QP route solved.
        times: one per round [ms].
        kkt: largest KKT number, not a number for a peer.
        states, controls: where it ended.
        refined: cost at which IPOPT ends when started there; not a number where that was not tried.
    """

    status: str = ""
    iterations: int = 0
    cost: float = np.nan
    routes: dict[str, int] = field(default_factory=dict)
    times: list[float] = field(default_factory=list)
    kkt: float = np.nan
    states: Array = field(default_factory=lambda: np.zeros((0, 3)))
    controls: Array = field(default_factory=lambda: np.zeros((0, 2)))
    refined: float = np.nan

    @property
    def good(self) -> bool:
        """Whether it is a KKT point to what counts as solved."""
        return self.status == "converged" or self.kkt <= GOOD

    @property
    def median(self) -> float:
        """[ms]."""
        return float(np.median(self.times))


Attempt = Callable[[Outcome], None]


def attempt(solver: fg.Solver, problem: Problem) -> Attempt:
    """A cold solve by one of our backends: graph compiled before, workspaces and factorisations timed."""
    formulation = Formulation(problem)

    def solve(outcome: Outcome) -> None:
        run = solver.prepare(formulation.graph)
        begin = time.thread_time()
        solution = run.solve(formulation.guess)
        outcome.times.append(1e3 * (time.thread_time() - begin))
        outcome.status = solution.status.name.lower().replace("_", " ")
        outcome.iterations, outcome.cost = solution.iterations, solution.cost
        outcome.kkt = max(solution.stationarity, solution.violation, solution.complementarity)
        outcome.states, outcome.controls = solution[formulation.x], solution[formulation.u]
        routes = (str(row.details.get("qp", "")).partition(":")[0] for row in solution.history)
        outcome.routes = dict(Counter(route for route in routes if route not in ("", "none")))

    return solve


def attempt_peer(problem: Problem, plugin: str) -> Attempt:
    """A cold solve through casadi: expressions built and differentiated before, the solve timed."""
    peer = Peer(problem, plugin)
    guess = problem.guess()

    def solve(outcome: Outcome) -> None:
        outcome.times.append(peer.solve(*guess))
        outcome.status, outcome.iterations, outcome.cost = peer.status, peer.iterations, peer.cost

    return solve


def refine(problem: Problem, outcome: Outcome) -> float:
    """Cost at which IPOPT ends from an answer; its barrier begins small, or it would leave any answer at a limit."""
    near = {"bound_push": 1e-9, "bound_frac": 1e-9, "slack_bound_push": 1e-9, "slack_bound_frac": 1e-9}
    peer = Peer(problem, "ipopt", **{**near, "mu_init": 1e-8, "tol": 1e-9})
    states = outcome.states.copy()
    states[:, 2] = np.unwrap(states[:, 2])
    peer.solve(states, outcome.controls)
    return peer.cost if peer.status == "converged" else np.inf


def measure(problem: Problem, rounds: int) -> dict[str, Outcome]:
    """Solve a problem with every solver in turn, ``rounds`` times: a slow moment of the machine meets all of them."""
    attempts = {
        "ipm": attempt(InteriorPoint(), problem),
        "alm": attempt(AugmentedLagrangian(), problem),
        "sqp": attempt(SQP(), problem),
    }
    attempts[ALONE] = attempt(SQP(fallback=None, qp_iterations=4000), problem)
    compare = find_spec("casadi") is not None
    if compare:
        attempts |= {name: attempt_peer(problem, name) for name in PEERS}
    outcomes = {name: Outcome() for name in attempts}
    for _ in range(rounds):
        for name, solve in attempts.items():
            if max(outcomes[name].times, default=0.0) < SLOW:
                solve(outcomes[name])
    for name, outcome in outcomes.items():
        if compare and name not in PEERS and not verdict(problem, outcome).startswith(("listed", "not")):
            outcome.refined = refine(problem, outcome)
    return outcomes


def verdict(problem: Problem, outcome: Outcome) -> str:
    """How the cost found compares with the known optima."""
    if not outcome.good:
        return "not solved"
    relative = [(outcome.cost - known) / known for known in problem.optima]
    if abs(relative[0]) < SAME:
        return "listed"
    if min(map(abs, relative)) < SAME:
        return "listed alternative"
    return "lower" if relative[0] < 0.0 else f"other, {100.0 * relative[0]:+.2g} %"


def stays(outcome: Outcome) -> str:
    """Whether IPOPT stays at an answer that is in no list."""
    if np.isnan(outcome.refined):
        return "-"
    if np.isinf(outcome.refined):
        return "fails"
    same = abs(outcome.refined - outcome.cost) <= STAYS * abs(outcome.cost)
    return "stays" if same else f"goes to {outcome.refined:.5f}"


def solved(problem: Problem, outcome: Outcome) -> bool:
    """Whether the answer is a known optimum to 1e-4, or one at which IPOPT stays."""
    known = min(abs(outcome.cost - known) / known for known in problem.optima) < 1e-4
    return outcome.good and (known or stays(outcome) == "stays")


def ratio(outcomes: dict[str, Outcome], name: str, peer: str) -> float:
    """Time over that of a peer; not a number where there is none or it did not converge."""
    if peer not in outcomes or name in PEERS or outcomes[peer].status != "converged":
        return np.nan
    return outcomes[name].median / outcomes[peer].median


def render(results: dict[Problem, dict[str, Outcome]], loops: str, rounds: int) -> str:
    """The results as Markdown."""
    head = (
        "problem", "solver", "status", "optimum", "IPOPT from there", "KKT", "cost", "listed", "iterations", "ms",
        *(f"times {peer}" for peer in PEERS), "OSQP QPs", "fallback QPs", "elastic QPs",
    )  # fmt: skip
    lines = []
    for problem, outcomes in results.items():
        for name, outcome in outcomes.items():
            counts = [str(outcome.routes.get(route, 0)) for route in ("osqp", "piqp", "elastic")]
            lines.append(
                (
                    problem.name, name, outcome.status, verdict(problem, outcome), stays(outcome),
                    "-" if np.isnan(outcome.kkt) else f"{outcome.kkt:.0e}", f"{outcome.cost:.5f}",
                    f"{problem.optima[0]:.5f}", str(outcome.iterations), f"{outcome.median:.1f}",
                    *(_number(ratio(outcomes, name, peer)) for peer in PEERS),
                    *(counts if name.startswith("sqp") else "---"),
                )
            )  # fmt: skip
    packages = ("unifg", "numpy", "scipy", "osqp", "piqp", "qdldl")
    peer_package = ("casadi",) if any("ipopt" in outcomes for outcomes in results.values()) else ()
    notes = (
        f"Median processor time of {rounds} interleaved cold solves (one where it took more than {SLOW / 1e3:.0f} s), "
        f"tolerance 1e-6 each. KKT: largest number of our own test, scaled as in unifg.answers.optimality. Solved: KKT below "
        f"{GOOD:.0e} (peers: converged), and a cost within 1e-4 of a known optimum or one at which IPOPT stays, to "
        f"{STAYS:.0e}, when it "
        "is started there at tolerance 1e-9; IPOPT is asked wherever the cost is not a known one to 1e-5. Staying "
        "shows a KKT point, not that it is a minimum. QPs: accepted iterations by the route that solved their "
        "subproblem. Times: ours over the peer's, where the peer converged. "
        f"{machine(*packages, *peer_package)}"
    )
    return "\n\n".join([_summary(results), table(head, lines, text=5), notes, loops])


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


def _summary(results: dict[Problem, dict[str, Outcome]]) -> str:
    names = dict.fromkeys(name for outcomes in results.values() for name in outcomes)
    lines = []
    for name in names:
        mine = {problem: outcomes[name] for problem, outcomes in results.items()}
        times = np.array([outcome.median for outcome in mine.values()])
        means = []
        for peer in PEERS:
            ratios = np.array([ratio(outcomes, name, peer) for outcomes in results.values()])
            ratios = ratios[~np.isnan(ratios)]
            means.append(float(np.exp(np.mean(np.log(ratios)))) if len(ratios) else np.nan)
        lines.append(
            (
                name,
                f"{sum(outcome.status == 'converged' for outcome in mine.values())} / {len(mine)}",
                f"{sum(solved(problem, outcome) for problem, outcome in mine.items())} / {len(mine)}",
                f"{sum(verdict(problem, outcome) == 'listed' for problem, outcome in mine.items())} / {len(mine)}",
                f"{np.median(times):.1f}",
                f"{times.max():.1f}",
                *map(_number, means),
            )
        )
    columns = (f"times {peer} (geometric mean)" for peer in PEERS)
    head = ("solver", "converged", "solved", "listed optimum", "median [ms]", "slowest [ms]", *columns)
    return table(head, lines)


def drive() -> str:
    """The closed loops as Markdown."""
    cases = itertools.product(("straight", "behind"), (False, True), (50,))
    return closed_loop.render({problem: closed_loop.drive(problem) for problem in itertools.starmap(Problem, cases)})


def main(arguments: list[str] | None = None) -> int:
    """Solve everything and write the tables; 0 only if our backends converge everywhere."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.reference_problems", description=__doc__.split("\n")[0])
    parser.add_argument("--rounds", type=int, default=5, help="solves of every problem by every solver")
    options = parser.parse_args(arguments)
    if find_spec("casadi") is None:
        print("casadi is not installed: no comparison with IPOPT and fatrop.")
    for problem in problems()[::3]:  # with and without discs: what is compiled is compiled before any clock runs
        measure(problem, 1)
    results = {problem: measure(problem, options.rounds) for problem in tqdm(problems(), unit="problem")}
    text = render(results, drive(), options.rounds)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "reference-problems.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    print(text)
    put_results(CHECKOUT / "docs" / "reference-problems.md", "Reference problems", text)
    ours = [outcomes[name] for outcomes in results.values() for name in ("ipm", "alm", "sqp")]
    return 0 if all(outcome.status == "converged" for outcome in ours) else 1


if __name__ == "__main__":
    raise SystemExit(main())
