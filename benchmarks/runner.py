"""Runner of all measurements: cells of problems, contestants and seeds, each a row; tables of rows; pages of tables.

A row is a line of out/benchmarks as soon as it is there, and is not measured again until the code changes.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from itertools import product
from typing import Any, TypeAlias

from tqdm import tqdm

from benchmarks.comparison import Key, Row
from benchmarks.report import CHECKOUT, OUT, commit, machine, publish
from benchmarks.timing import pin
from unifg.errors import UnifgError
from unifg.scenarios.campaigns.journal import Journal, lines_of
from unifg.scenarios.workers import Workers, finished

RESULTS = CHECKOUT / "docs" / "results"


Cell: TypeAlias = Mapping[str, Any]
"""Arguments of a measurement by name, strings and numbers: a problem, a contestant and a seed."""


def every(**choices: Iterable[Any]) -> Callable[[Sequence[int]], list[Cell]]:
    """Cells of every combination of choices on every seed, which comes first."""
    names = "seed", *choices
    return lambda seeds: [dict(zip(names, one, strict=True)) for one in product(seeds, *choices.values())]


class Unavailable(Exception):
    """Something that a study needs is not installed; the message says how to get it."""


@dataclass(frozen=True)
class Study:
    """Cells that are measured one by one, and the tables of their rows.

    Attributes:
        cells: all cells for some seeds.
        measure: a row of one cell, which are its arguments; a function that can be pickled.
        tables: Markdown of all rows.
        seeds: of the page.
        alone: cells that are measured one at a time, after the others.
    """

    cells: Callable[[Sequence[int]], Iterable[Cell]]
    measure: Callable[..., Row]
    tables: Callable[[list[Row]], str]
    seeds: Sequence[int] = range(1)
    alone: Callable[[Cell], bool] = lambda cell: False

    def run(self, name: str, chosen: argparse.Namespace) -> str:
        """Measure the cells that are missing on file; the tables of all rows of these seeds.

        Args:
            name: of the study, and of its file in out/benchmarks.
            chosen: command line.
        """
        seeds = chosen.seeds or self.seeds
        cells = {tuple(cell.values()): cell for cell in self.cells(seeds)}
        rows = dict[Key, Row]()
        for workers, alone in ((chosen.workers, False), (1, True)):
            batch = {key: cell for key, cell in cells.items() if self.alone(cell) is alone}
            rows |= recorded(name, partial(row_of, self.measure, workers), batch, chosen, workers)
        found = [rows[key] for key in cells if key in rows]
        if not found:
            raise SystemExit(f"Nothing on file in {OUT / name}.jsonl for this state of the code.")
        return f"{self.tables(found)}\n\n{machine({row['code'] for row in found})}"


@dataclass(frozen=True)
class Timing:
    """Contestants that are timed in turn, on one core, in many rounds.

    Attributes:
        tables: measures and returns Markdown, given the number of rounds.
        rounds: of the page.
    """

    tables: Callable[[int], str]
    rounds: int = 15

    def run(self, name: str, chosen: argparse.Namespace) -> str:
        """Measure everything; the tables."""
        pin()
        return f"{self.tables(chosen.rounds or self.rounds)}\n\n{machine()}"


PAGES = {
    "bazzana": {"experiments": 3.0, "against_ipopt": 0.1},
    "ta": {
        "obstacle_fields": 0.1, "obstacle_courses": 0.25, "quadrotor_flights": 1.5, "quadrotor_pull": 0.15,
        "many_landmarks": 0.02,
    },
    "factormpc": {
        "safe_campaign": 0.6, "guarded_flights": 0.15, "horizon_and_velocity": 0.15, "learned_residual": 0.05,
    },
    "ecg2o": {"ecg2o": 0.1},
    "unification": {
        "coupling": 0.8, "covariance_plans": 0.1, "active_perception": 0.1, "shared_dynamics": 0.1,
        "excluded_pasts": 0.05,
    },
    "control": {
        "control_cases": 0.4, "moved_goals": 0.1, "many_instances": 0.02, "derivatives": 0.02, "exported": 0.01,
        "own_functions": 0.1, "claims": 0.2,
    },
    "collection": {"collection": 0.1, "cops": 0.05},
    "pose-graphs": {
        "elimination": 0.1, "incremental": 0.1, "wrong_closures": 4.0, "verdicts": 0.3, "beyond_memory": 0.6,
    },
    "navigation": {"navigation": 0.1, "localisation": 0.15, "movers": 1.0},
    "reliability": {"faults": 0.3, "fault_search": 0.15, "mujoco": 0.25},
    "first-use": {"first_use": 0.2},
    "peers": {"peers": 0.1},
}  # fmt: skip
"""Pages of docs/results: the studies of each, and about how many hours they take on two cores."""


def row_of(measure: Callable[..., Row], workers: int, cell: Cell) -> Row:
    """Row of a cell: its arguments, the number of workers, and what was measured or why that was refused."""
    try:
        return {**cell, "workers": workers, **measure(**cell)}
    except UnifgError as error:
        return {**cell, "workers": workers, "refused": str(error)}


def recorded(
    name: str, task: Callable[[Cell], Row], cells: dict[Key, Cell], chosen: argparse.Namespace, workers: int
) -> dict[Key, Row]:
    """Rows on file by key, after measuring the cells that are missing there.

    The file only grows: of two rows with one key the later one counts.

    Args:
        name: of the study.
        task: row of a cell.
        cells: to measure, by key.
        chosen: ``report`` measures nothing and, like ``any_code``, takes rows of any state of the code; ``fresh``
            measures all cells again.
        workers: processes; with one, cells are measured in this process.
    """
    store, code, any_code = OUT / f"{name}.jsonl", commit(), chosen.report or chosen.any_code
    rows = {tuple(row["key"]): row for row in lines_of(store) if any_code or row["code"] == code}
    missing = {key: cell for key, cell in cells.items() if not chosen.report and (chosen.fresh or key not in rows)}
    if missing:
        with Journal(store) as journal:
            for key, row in tqdm(measured(task, missing, workers), total=len(missing)):
                rows[key] = {"key": key, "code": code, **row}
                journal.add(json.dumps(rows[key], default=lambda value: value.tolist()))  # numbers of NumPy
    return rows


def measured(task: Callable[[Cell], Row], cells: dict[Key, Cell], workers: int) -> Iterator[tuple[Key, Row]]:
    """Rows of cells as they come."""
    if workers == 1:
        yield from ((key, task(cell)) for key, cell in cells.items())
        return
    keys = {id(cell): key for key, cell in cells.items()}
    executor = Workers(workers)
    try:
        for cell, future in finished(executor, task, cells.values(), lambda: workers):
            yield keys[id(cell)], future.result()
    finally:
        executor.kill()


def seeds(text: str) -> range:
    """Range of seeds from the command line, such as 0:100."""
    begin, _, end = text.partition(":")
    if not (begin.isdecimal() and end.isdecimal() and int(begin) < int(end)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of seeds: expected FIRST:END, such as 0:100")
    return range(int(begin), int(end))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure studies or pages and write them; without a name, list them."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__, allow_abbrev=False)
    names = [*PAGES, *(name for page in PAGES.values() for name in page)]
    parser.add_argument("names", nargs="*", metavar="NAME", help="pages, studies, or all")
    parser.add_argument("--seeds", type=seeds, metavar="FIRST:END", help="instead of those of the page")
    parser.add_argument("--rounds", type=int, help="of times, instead of those of the page")
    parser.add_argument("--workers", type=int, default=1, help="cells at once; times mean something for one alone")
    parser.add_argument("--fresh", action="store_true", help="repeat cells that are on file")
    parser.add_argument("--report", action="store_true", help="measure nothing, write the tables from what is on file")
    parser.add_argument("--any-code", action="store_true", help="cells of earlier states of the code count, too")
    chosen = parser.parse_args(arguments)
    if unknown := set(chosen.names) - {"all", *names}:
        parser.error(f"no page or study {', '.join(unknown)}; there are {', '.join(names)}")
    for page, studies in PAGES.items():
        if not chosen.names:
            print(f"{page:14} {', '.join(studies)}; about {sum(studies.values()):g} h")
        for name in studies:
            if {"all", page, name} & set(chosen.names):
                study: Study | Timing = import_module(f"benchmarks.{name}").STUDY
                whole = chosen.seeds is None and chosen.rounds is None
                try:
                    publish(RESULTS / f"{page}.md", name, study.run(name, chosen), whole)
                except Unavailable as reason:
                    print(f"{name} is left out: {reason}")
    return 0
