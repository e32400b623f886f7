"""COPS 3.0 and textbook problems with costs that are no squares, beside IPOPT, and the same problems in other units.

The problems are stated in tests/problems/cops.py; IPOPT gets the same functions, mesh, guess and tolerance, through
CasADi with exact derivatives and MUMPS, and its default options.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.report import table, words
from benchmarks.runner import Timing
from benchmarks.timing import clocked, interleave, number, ratio
from problems.cops import LEFT_OUT, PROBLEMS, Problem
from problems.cops_casadi import program
from problems.scaled import Units, scaled
from unifg.solvers import InteriorPoint

TOLERANCE = 1e-8
SAME = 1e-4  # relative, of costs
SOLVED = ("converged", "solve succeeded")
CHANGES = {
    "cost x 1e-6": Units(cost=1e-6), "cost x 1e6": Units(cost=1e6), "rows x 1e-6": Units(rows=1e-6),
    "rows x 1e6": Units(rows=1e6), "unknowns x 1e-6": Units(unknowns=1e-6), "unknowns x 1e6": Units(unknowns=1e6),
    "unknowns + 5e6": Units(offset=5e6), "terms reversed": Units(backwards=True),
}  # fmt: skip


class Ours:
    """The interior point on a problem."""

    def __init__(self, problem: Problem, units: Units | None = None, tolerance: float = TOLERANCE) -> None:
        """Prepare."""
        graph, guess = problem.build()
        if units is not None:
            graph, guess = scaled(graph, guess, units)
        feasible = None if units is None else tolerance * units.rows
        solver = InteriorPoint(tolerance=tolerance, feasibility_tolerance=feasible)
        self._guess, self._run = guess, solver.prepare(graph)

    def __call__(self) -> float:
        """Solve; processor time [s]."""
        solution, spent = clocked(self._run.solve, self._guess)
        self.status, self.iterations, self.cost = words(solution.status), solution.iterations, solution.cost
        self.iterations += solution.restoration_steps
        return spent


class Ipopt:
    """IPOPT on a problem."""

    def __init__(self, problem: Problem) -> None:
        """Differentiate."""
        import casadi as ca

        stated, self._call = program(problem.build())
        options: dict[str, Any] = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": TOLERANCE}}
        self._solver: Any = ca.nlpsol("solver", "ipopt", stated, options)

    def __call__(self) -> float:
        """Solve; processor time [s]."""
        found, spent = clocked(self._solver, **self._call)
        stats = self._solver.stats()
        self.status = str(stats["return_status"]).replace("_", " ").lower()
        self.iterations, self.cost = int(stats["iter_count"]), float(found["f"])
        return spent


def verdict(problem: Problem, solver: Ours | Ipopt) -> str:
    """Comparison of an answer with the literature's."""
    if solver.status not in SOLVED:
        return solver.status
    off = (solver.cost - problem.best) / abs(problem.best)
    return "literature's" if abs(off) <= SAME else f"{'better' if off < 0 else 'another'}, {100.0 * off:+.2g} %"


def beside(rounds: int) -> str:
    """Every problem by both."""
    lines, iterations, times = [], [], []
    counts = {name: [0, 0] for name in ("InteriorPoint", "IPOPT")}
    for problem in tqdm(PROBLEMS, unit="problem"):
        ours, peer = Ours(problem), Ipopt(problem)
        spent = interleave({"ours": ours, "ipopt": peer}, rounds, slow=5.0)
        found = {"InteriorPoint": verdict(problem, ours), "IPOPT": verdict(problem, peer)}
        for name, word in found.items():
            counts[name][0] += word == "literature's"
            counts[name][1] += word.startswith(("better", "another"))
        both = ours.status in SOLVED and peer.status in SOLVED
        relative = ratio(spent["ours"], spent["ipopt"])[0]
        if both:
            iterations.append((ours.iterations / peer.iterations, problem.name))
            times.append((relative, problem.name))
        medians = [1e3 * float(np.median(spent[name])) for name in ("ours", "ipopt")]
        lines.append(
            (
                problem.name, problem.mesh, f"{problem.best:.6g}", *found.values(), str(ours.iterations),
                str(peer.iterations), number(medians[0]), number(medians[1]), number(relative, 2),
            )
        )  # fmt: skip
    head = (
        "problem", "mesh", "literature", "InteriorPoint", "IPOPT", "iterations", "IPOPT's", "ms", "IPOPT's ms",
        "time ratio",
    )  # fmt: skip

    def mean(pairs: list[tuple[float, str]]) -> str:
        middle = float(np.exp(np.mean([np.log(value) for value, _ in pairs])))
        worst = max(pairs)
        return f"{middle:.2f} in the geometric mean, {worst[0]:.2f} at worst ({worst[1]})"

    said = (
        f"Solved to the literature's cost within {SAME:.0e}: InteriorPoint {counts['InteriorPoint'][0]}, IPOPT "
        f"{counts['IPOPT'][0]} of {len(PROBLEMS)}; to another optimum {counts['InteriorPoint'][1]} and "
        f"{counts['IPOPT'][1]}. Where both converge, InteriorPoint takes {mean(iterations)} of IPOPT's iterations and "
        f"{mean(times)} of its time. Tolerance {TOLERANCE:.0e}, median processor times of {rounds} interleaved solves; "
        "IPOPT's functions run in CasADi's virtual machine. Iterations of both include those of their feasibility "
        "restoration."
    )
    left = "\n".join(f"- {name}: {why}" for name, why in LEFT_OUT.items())
    return f"{said}\n\n{table(head, lines, 5)}\n\nLeft out of COPS 3.0:\n\n{left}"


def units() -> str:
    """The same problems in other units."""
    lines = []
    for problem in tqdm(PROBLEMS, unit="problem"):
        cells = []
        for change in (Units(), *CHANGES.values()):
            ours = Ours(problem, change, 1e-6)
            ours()
            cells.append((ours.status, ours.iterations, ours.cost / change.cost))
        shown = [f"{status if status != 'converged' else ''} {its} ({cost:.6g})".strip() for status, its, cost in cells]
        lines.append((problem.name, *shown))
    head = ("problem", "as stated", *CHANGES)
    notes = (
        "Iterations (cost, divided by its factor), tolerance 1e-6, that of the violation times the factor of the rows; "
        "a status is named where it is not converged. Numbers near 5e6 are stored to 1e-9, which some rows multiply."
    )
    return f"{table(head, lines, 1)}\n\n{notes}"


def tables(rounds: int) -> str:
    """Both."""
    parts: list[Callable[[], str]] = [lambda: beside(rounds), units]
    return "\n\n".join(part() for part in parts)


STUDY = Timing(tables, 7)
