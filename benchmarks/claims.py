"""What the backends claim about problems of control, judged from outside.

    python -m benchmarks.claims [--parkings P] [--seeds S] [--kinds K ...] [--backends B ...] [--workers W]

A hundred parkings of a kinematic bicycle and fourteen other kinds of control problem, each stated twice
(tests/problems/twins): as a graph with residuals as a user writes them, and in casadi, whose exact derivatives judge
what every backend answers (tests/exact_judge.py). Needs casadi. Every problem is a line of
out/benchmarks/claims.jsonl and is not solved again until the code changes. Writes docs/claims.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, TypeAlias

import numpy as np

import unifg as fg
from benchmarks.comparison import Key, Row
from benchmarks.report import OUT, command, commit, listing, machine, publish, table
from benchmarks.runs import options, recorded
from exact_judge import AGREED, Answer, Judge, Peer, answer, disagreement
from problems.twins import KINDS
from variants import CONSTRAINED, EQUALITIES_ONLY

TOLERANCE = 1e-6
SAME = 1e-4  # relative difference below which two costs are one optimum
EQUALITY_BACKENDS: dict[str, fg.Solver] = {"kkt": EQUALITIES_ONLY["kkt"], **CONSTRAINED}


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


@dataclass(frozen=True)
class Job:
    """One problem and who solves it."""

    kind: str
    seed: int
    equalities_only: bool
    backends: tuple[str, ...]


def measure(job: Job) -> Case:
    """State a problem, solve it with everything."""
    twin = KINDS[job.kind](job.seed, job.equalities_only)
    judge = Judge(twin)
    apart = disagreement(twin, judge)
    if apart > AGREED:
        raise RuntimeError(f"{twin.name}: the graph and the casadi statement differ by {apart:.1e}")
    answers = {name: answer(EQUALITY_BACKENDS[name], twin, judge) for name in job.backends}
    ipopt, fatrop = judge.ipopt(twin.guess, TOLERANCE), judge.fatrop(twin.guess, TOLERANCE)
    return Case(job.kind, job.seed, job.equalities_only, answers, ipopt, fatrop)


def results(cases: Iterable[Case]) -> dict[str, list[Case]]:
    """Cases by kind, those without inequalities marked."""
    found: dict[str, list[Case]] = {}
    for case in cases:
        found.setdefault(case.kind + (" =" if case.equalities_only else ""), []).append(case)
    return found


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

    columns: dict[str, Callable[[Mine], str]] = {
        "converged": lambda mine: f"{len(solved(mine))} / {len(mine)}",
        "false": lambda mine: str(sum(a.claim == "false" for _, a in solved(mine))),
        "largest exact KKT number": worst,
        "infeasible: true / saddle / false": dead,
        "lost to IPOPT": lambda mine: str(sum(case.ipopt.solved and a.status != "CONVERGED" for case, a in mine)),
        "IPOPT lost": lambda mine: str(sum(not case.ipopt.solved for case, _ in solved(mine))),
        "cost below / at / above IPOPT's": beside,
        "iterations": lambda mine: f"{np.median([a.iterations for _, a in solved(mine)]):.0f}" if solved(mine) else "-",
        "CPU [s]": lambda mine: f"{np.median([a.seconds for _, a in mine]):.2f}",
    }
    groups = {(name,): [(case, case.answers[name]) for case in cases if name in case.answers] for name in names}
    return listing(["backend"], groups, columns)


def endings(case_list: list[Case], name: str) -> str:
    """How the solves of one kind by one backend ended."""
    counts = Counter(case.answers[name].status for case in case_list if name in case.answers)
    if not counts:
        return "-"
    converged = counts.pop("CONVERGED", 0)
    others = ", ".join(f"{count} {status.lower().replace('_', ' ')}" for status, count in counts.most_common())
    return f"{converged} / {converged + sum(counts.values())}" + (f" ({others})" if others else "")


def render(cases: list[Case]) -> str:
    """All tables."""
    groups = results(cases)
    names = [name for name in EQUALITY_BACKENDS if any(name in case.answers for case in cases)]
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
    rows = []
    for kind, group in groups.items():
        peers = [c.fatrop for c in group if c.fatrop is not None]
        rows.append(
            (
                kind,
                f"{sum(c.ipopt.solved for c in group)} / {len(group)}",
                f"{sum(peer.solved for peer in peers)} / {len(peers)}" if peers else "-",
                *(endings(group, name) for name in names),
            )
        )
    parts += ["Converged of all, with the other endings:", table(("kind", "IPOPT", "fatrop", *names), rows)]
    wrong = [
        f"- {case.kind} {case.seed}{' =' if case.equalities_only else ''}, {name}: `{a.status}`, but {a.reason}."
        for case in cases for name, a in case.answers.items() if a.claim == "false"
    ]  # fmt: skip
    parts.append("\n".join(["False claims:", "", *wrong]) if wrong else "There is no false claim.")
    parts.append(
        f"Tolerance {TOLERANCE:.0e} of every solver, default options. Lost: IPOPT says it solved the problem from the "
        f"same guess and the backend does not. Same cost: within {SAME:.0e}. Iterations are medians of converged "
        f"solves, times those of all, the processor's. {machine('numpy', 'numba', 'casadi')}"
    )
    return "\n\n".join(parts)


def solve(job: Job) -> Row:
    """All answers to one problem, as the file holds them."""
    return asdict(measure(job))


def jobs(parkings: int, seeds: int, kinds: Sequence[str], only: Sequence[str]) -> dict[Key, Job]:
    """What is to be solved, by what tells it apart: every kind but the parkings without its inequalities, too."""
    found = []
    for kind in kinds:
        for equalities_only in (False,) if kind == "parking" else (False, True):
            backends = EQUALITY_BACKENDS if equalities_only else CONSTRAINED
            asked = tuple(name for name in backends if name in only)
            count = parkings if kind == "parking" else seeds
            found += [Job(kind, seed, equalities_only, asked) for seed in range(count)]
    return {(job.kind, job.seed, job.equalities_only): job for job in found}


def main(arguments: list[str] | None = None) -> int:
    """Measure and write; 0 only without a false claim."""
    kinds, names = list(KINDS), list(EQUALITY_BACKENDS)
    parser = command(__doc__)
    parser.add_argument("--parkings", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=5, help="of every other kind")
    parser.add_argument("--kinds", nargs="+", choices=kinds, default=kinds, metavar="KIND", help="only these")
    parser.add_argument("--backends", nargs="+", choices=names, default=names, metavar="BACKEND", help="only these")
    parser.add_argument("--quick", action="store_true", help="write no page")
    options(parser)
    chosen = parser.parse_args(arguments)
    all_backends = set(chosen.backends) == set(names)
    chosen.fresh |= not all_backends
    store = OUT / ("claims.jsonl" if all_backends else "claims-some.jsonl")
    asked = jobs(chosen.parkings, chosen.seeds, chosen.kinds, chosen.backends)
    rows = recorded(solve, asked, store, commit(), chosen)
    cases = [restored(row) for row in rows if all_backends or row["key"] in asked]
    whole = all_backends and set(chosen.kinds) == set(kinds)
    publish("claims", render(cases), {row["code"] for row in rows}, docs=whole and not chosen.quick)
    return 1 if any(a.claim == "false" for case in cases for a in case.answers.values()) else 0


def restored(row: Mapping[str, Any]) -> Case:
    """A case from its line of the file."""
    answers = {name: Answer(**a) for name, a in row["answers"].items()}
    fatrop = None if row["fatrop"] is None else Peer(**row["fatrop"])
    return Case(row["kind"], row["seed"], row["equalities_only"], answers, Peer(**row["ipopt"]), fatrop)


if __name__ == "__main__":
    raise SystemExit(main())
