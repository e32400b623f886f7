"""Every backend on a collection of small problems with known answers; IPOPT beside them.

    python -m benchmarks.collection [DAY]   repeats two cells of the page, drawn by the date

The problems are those of the tests (tests/problems/collection.py): Hock and Schittkowski's, least squares, degenerate
and infeasible ones, and problems on Lie groups. A backend takes the problems of its class. Answers are judged by
`tests/judge.py`, which shares no code with the solvers.
"""

from __future__ import annotations

import datetime
import random
import re
from collections import Counter
from importlib.util import find_spec
from typing import TypeAlias

from benchmarks.comparison import Key
from benchmarks.report import END, command, table
from benchmarks.runner import RESULTS, Timing
from problems.collection import (
    BACKENDS,
    CASES,
    DEGENERATE_POINT,
    GROUPS,
    INFEASIBLE_POINT,
    OPTIMUM,
    OTHER,
    RIGHT,
    Outcome,
    Problem,
    attempt,
    ipopt,
)
from problems.hock_schittkowski import Case

Outcomes: TypeAlias = dict[str, dict[str, Outcome]]
"""By backend and problem."""
PEER = "IPOPT"
DRAWN = 2  # cells of a sample


def measure() -> Outcomes:
    """Outcomes by backend and problem; refused problems are left out."""
    results: Outcomes = {}
    for name, backend in BACKENDS.items():
        found = {case: attempt(case, backend) for case in CASES}
        results[name] = {case: outcome for case, outcome in found.items() if outcome is not None}
    if find_spec("casadi") is not None:
        results[PEER] = {name: ipopt(case) for name, case in CASES.items() if isinstance(case, Case)}
    return results


def render(results: Outcomes) -> str:
    """The page."""
    notes = "Default options, one solve from the standard start of each problem."
    parts = [notes, _summary(results), "## What is not solved", _failures(results)]
    for title, cases in GROUPS.items():
        parts += [f"## Iterations: {title}", _iterations(results, cases)]
    return "\n\n".join(parts)


def repeated(page: str, seed: str) -> bool:
    """Repeat some cells of the tables of iterations; True if all lie where the page says a repeated count lies.

    Args:
        page: the Markdown.
        seed: of the draw.
    """
    known: dict[Key, str] = {}
    for part in page.partition(END)[0].split("## Iterations: ")[1:]:
        head, _, *lines = (
            [word.strip() for word in line.split("|")[1:-1]] for line in part.splitlines() if "|" in line
        )
        known |= {(line[0], name): cell for line in lines for name, cell in zip(head[1:], line[1:], strict=True)}
    cells = [place for place, cell in known.items() if cell != "-" and place[1] in BACKENDS and place[0] in CASES]
    good = True
    for case, name in random.Random(seed).sample(cells, DRAWN):
        now, then = _cell(attempt(case, BACKENDS[name])), known[case, name]
        same = _alike(now, then)
        print(f"{case}, {name}: {then} on the page, {now} now{'' if same else ': not the same'}")
        good = good and same
    return good


def _alike(now: str, then: str) -> bool:
    """True for cells with the same mark whose counts differ by two or a tenth at most."""
    (count, *mark), (expected, *other) = (re.split(r"(?<=\d)(?=\D|$)", cell) for cell in (now, then))
    return mark == other and abs(int(count) - int(expected)) <= max(2.0, 0.1 * int(expected))


def _summary(results: Outcomes) -> str:
    lines = []
    for name, outcomes in results.items():
        count = Counter(outcome.verdict for outcome in outcomes.values())
        right = sum(count[word] for word in RIGHT)
        share = f"{100.0 * right / len(outcomes):.1f} %"
        lines.append(
            (name, str(len(outcomes)), *(str(count[word]) for word in RIGHT), str(len(outcomes) - right), share)
        )
    words = "known optimum", "other KKT point", "degenerate, says so", "infeasible, says so"
    return table(("backend", "takes", *words, "not solved", "right"), lines)


def _failures(results: Outcomes) -> str:
    lines = []
    for name, outcomes in results.items():
        wrong: dict[str, list[str]] = {}
        for case, outcome in outcomes.items():
            if not outcome.right:
                wrong.setdefault(outcome.verdict, []).append(case)
        lines += [(name, word, ", ".join(cases)) for word, cases in wrong.items()]
    return table(("backend", "ended with", "problems"), lines, text=3)


def _iterations(results: Outcomes, cases: list[Problem]) -> str:
    names = [name for name, outcomes in results.items() if any(case.name in outcomes for case in cases)]
    lines = [(case.name, *(_cell(results[name].get(case.name)) for name in names)) for case in cases]
    return table(("problem", *names), lines)


def _cell(outcome: Outcome | None) -> str:
    if outcome is None:
        return "-"
    mark = {OPTIMUM: "", OTHER: "*", DEGENERATE_POINT: "", INFEASIBLE_POINT: ""}.get(outcome.verdict, " (no)")
    return f"{outcome.iterations}{mark}"


STUDY = Timing(lambda rounds: render(measure()), 1)


def main(arguments: list[str] | None = None) -> int:
    """Repeat two cells of the page; 1 if one of them differs."""
    parser = command(__doc__)
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    parser.add_argument("day", nargs="?", default=today, help="draws the cells")
    chosen = parser.parse_args(arguments)
    return 0 if repeated((RESULTS / "collection.md").read_text(encoding="utf-8"), chosen.day) else 1


if __name__ == "__main__":
    raise SystemExit(main())
