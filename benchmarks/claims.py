"""Claims of the backends about problems of control, judged by exact derivatives.

A hundred parkings of a kinematic bicycle and fourteen other kinds of control problem, each stated twice
(tests/problems/twins): as a graph with residuals as a user writes them, and in casadi, whose exact derivatives judge
the answer of every backend (tests/exact_judge.py). Needs casadi.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import TypeAlias

import numpy as np

from benchmarks.comparison import Row, counted, middle
from benchmarks.report import Columns, listing
from benchmarks.runner import Cell, Study
from exact_judge import AGREED, Answer, Judge, Peer, answer, disagreement
from problems.twins import KINDS
from variants import CONSTRAINED

TOLERANCE = 1e-6
OTHERS = 5  # problems of every kind but parking
SAME = 1e-4  # relative difference below which two costs are one optimum
BACKENDS = {name: solver for name, solver in CONSTRAINED.items() if name not in ("kkt full", "kkt lm")}


@dataclass
class Case:
    """All answers to one problem."""

    kind: str
    seed: int
    equalities_only: bool
    answers: dict[str, Answer]
    ipopt: Peer
    fatrop: Peer | None


Mine: TypeAlias = list[tuple[Case, Answer]]


def measure(kind: str, seed: int, equalities_only: bool) -> Row:
    """State a problem, solve it with everything; all answers, as the file holds them."""
    twin = KINDS[kind](seed, equalities_only)
    judge = Judge(twin)
    apart = disagreement(twin, judge)
    if apart > AGREED:
        raise RuntimeError(f"{twin.name}: the graph and the casadi statement differ by {apart:.1e}")
    answers = {name: answer(backend, twin, judge) for name, backend in BACKENDS.items()}
    ipopt, fatrop = judge.ipopt(twin.guess, TOLERANCE), judge.fatrop(twin.guess, TOLERANCE)
    return asdict(Case(kind, seed, equalities_only, answers, ipopt, fatrop))


def summary(cases: list[Case], names: Iterable[str]) -> str:
    """One row per backend."""

    def solved(mine: Mine) -> Mine:
        return [(case, a) for case, a in mine if a.status == "CONVERGED"]

    def worst(mine: Mine) -> str:
        largest = [max(a.stationarity, a.violation, a.complementarity) for _, a in solved(mine)]
        return f"{max(largest):.2e}" if largest else "-"

    def dead(mine: Mine) -> str:
        claims = [a.claim for _, a in mine if a.status == "LOCALLY_INFEASIBLE"]
        return " / ".join(str(claims.count(word)) for word in ("true", "saddle", "false"))

    def beside(mine: Mine) -> str:
        both = np.array([a.cost / case.ipopt.cost - 1.0 for case, a in solved(mine) if case.ipopt.solved])
        return f"{(both < -SAME).sum()} / {(abs(both) <= SAME).sum()} / {(both > SAME).sum()}"

    columns: Columns[Mine] = {
        "converged": lambda mine: f"{len(solved(mine))} / {len(mine)}",
        "degenerate": counted(lambda _, a: a.status == "DEGENERATE"),
        "false": counted(lambda _, a: a.status == "CONVERGED" and a.claim == "false"),
        "largest exact KKT number": worst,
        "infeasible: true / saddle / false": dead,
        "lost to IPOPT": counted(lambda case, a: case.ipopt.solved and a.status != "CONVERGED"),
        "IPOPT lost": counted(lambda case, a: a.status == "CONVERGED" and not case.ipopt.solved),
        "cost below / at / above IPOPT's": beside,
        "iterations": lambda mine: middle([a.iterations for _, a in solved(mine)]),
        "CPU [s]": lambda mine: f"{np.median([a.seconds for _, a in mine]):.2f}",
    }
    groups = {(name,): [(case, case.answers[name]) for case in cases if name in case.answers] for name in names}
    return listing(["backend"], groups, columns)


def render(cases: list[Case]) -> str:
    """All tables."""
    names = [name for name in BACKENDS if any(name in case.answers for case in cases)]
    parts = []
    for title, chosen in (
        ("Parkings", [c for c in cases if c.kind == "parking"]),
        ("The other kinds", [c for c in cases if c.kind != "parking" and not c.equalities_only]),
        ("The other kinds, equalities only", [c for c in cases if c.equalities_only]),
    ):
        if chosen:
            staged = [c.fatrop for c in chosen if c.fatrop is not None]
            solved = [c.ipopt.iterations for c in chosen if c.ipopt.solved]
            often = f", in {np.median(solved):.0f} iterations in the median" if solved else ""
            parts.append(
                f"{title}: {len(chosen)} problems. IPOPT solves {len(solved)} of them{often}; "
                f"fatrop {sum(peer.solved for peer in staged)} of the {len(staged)} that have its form."
            )
            parts.append(summary(chosen, [n for n in names if any(n in c.answers for c in chosen)]))
    wrong = [
        f"- {case.kind} {case.seed}{' =' if case.equalities_only else ''}, {name}: `{a.status}`, but {a.reason}."
        for case in cases for name, a in case.answers.items() if a.claim == "false"
    ]  # fmt: skip
    parts.append("\n".join(["False claims:", "", *wrong]) if wrong else "There is no false claim.")
    parts.append(
        f"Tolerance {TOLERANCE:.0e} of every solver, default options. Lost: IPOPT says it solved the problem from the "
        f"same guess and the backend does not. Same cost: within {SAME:.0e}. Iterations are medians of converged "
        f"solves, times those of all, the processor's."
    )
    return "\n\n".join(parts)


def restored(row: Row) -> Case:
    """A case from its line of the file."""
    answers = {name: Answer(**a) for name, a in row["answers"].items()}
    fatrop = None if row["fatrop"] is None else Peer(**row["fatrop"])
    return Case(row["kind"], row["seed"], row["equalities_only"], answers, Peer(**row["ipopt"]), fatrop)


def cells(seeds: Sequence[int]) -> list[Cell]:
    """A parking for every seed; of the other kinds five, with and without their inequalities."""
    parkings: list[Cell] = [{"kind": "parking", "seed": seed, "equalities_only": False} for seed in seeds]
    return parkings + [
        {"kind": kind, "seed": seed, "equalities_only": equalities_only}
        for kind in KINDS if kind != "parking" for equalities_only in (False, True) for seed in seeds[:OTHERS]
    ]  # fmt: skip


STUDY = Study(cells, measure, lambda rows: render([restored(row) for row in rows]), range(100))
