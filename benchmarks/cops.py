"""COPS 3.0 and textbook problems with costs that are no squares, beside IPOPT, and the same problems in other units.

The problems are stated in tests/problems/cops.py; IPOPT gets the same functions, mesh, guess and tolerance, through
CasADi with exact derivatives and MUMPS, and its default options.
"""

from __future__ import annotations

import numpy as np
from tqdm import tqdm

import unifg as fg
from benchmarks.casadi_peer import Program
from benchmarks.cold import Ours
from benchmarks.report import table
from benchmarks.runner import Timing
from benchmarks.timing import interleave, number, ratio
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


def ours(problem: Problem, units: Units | None = None, tolerance: float = TOLERANCE) -> Ours:
    """The interior point on a problem."""
    graph, guess = problem.build()
    if units is not None:
        graph, guess = scaled(graph, guess, units)
    feasible = None if units is None else tolerance * units.rows
    return Ours(InteriorPoint(tolerance=tolerance, feasibility_tolerance=feasible), graph, fg.Guess(guess))


def ipopt(problem: Problem) -> Program:
    """IPOPT on a problem."""
    made, (stated, call) = Program(tol=TOLERANCE), program(problem.build())
    made.build(stated, **call)
    return made


def steps(one: Ours) -> int:
    """Iterations of a solve, with those of feasibility restoration."""
    return one.iterations + one.solution.restoration_steps


def verdict(problem: Problem, said: str, cost: float) -> str:
    """Comparison of an answer with the literature's."""
    if said not in SOLVED:
        return said
    off = (cost - problem.best) / abs(problem.best)
    return "literature's" if abs(off) <= SAME else f"{'better' if off < 0 else 'another'}, {100.0 * off:+.2g} %"


def beside(rounds: int) -> str:
    """Every problem by both."""
    lines, iterations, times = [], [], []
    counts = {name: [0, 0] for name in ("InteriorPoint", "IPOPT")}
    for problem in tqdm(PROBLEMS, unit="problem"):
        own, peer = ours(problem), ipopt(problem)
        spent = interleave({"ours": own, "ipopt": peer}, rounds, slow=5.0)
        found = {
            "InteriorPoint": verdict(problem, own.status, own.cost), "IPOPT": verdict(problem, peer.said, peer.cost),
        }  # fmt: skip
        for name, word in found.items():
            counts[name][0] += word == "literature's"
            counts[name][1] += word.startswith(("better", "another"))
        relative = ratio(spent["ours"], spent["ipopt"])[0]
        if own.status in SOLVED and peer.said in SOLVED:
            iterations.append((steps(own) / peer.iterations, problem.name))
            times.append((relative, problem.name))
        medians = [1e3 * float(np.median(spent[name])) for name in ("ours", "ipopt")]
        lines.append(
            (
                problem.name, problem.mesh, f"{problem.best:.6g}", *found.values(), str(steps(own)),
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
            own = ours(problem, change, 1e-6)
            own()
            cells.append((own.status, steps(own), own.cost / change.cost))
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
    return f"{beside(rounds)}\n\n{units()}"


STUDY = Timing(tables, 7)
