"""Speed of this machine at what the library does: ``unifg bench``.

Milliseconds differ from machine to machine, and on a shared one from minute to minute. So every case is measured right
after a reference that does the same everywhere, a little arithmetic in Python and a little in NumPy, both in processor
time, and the ratio counts. A record is a line of a file: the ratios of all rounds, and the kind of machine.
Against one of the same kind, a case is slower if the 95 % bootstrap interval of the ratio of its medians lies
above `SLOWER`.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from scipy.stats import bootstrap

import unifg as fg
from unifg.errors import ScenarioError
from unifg.models import obstacles, unicycle
from unifg.pose_graphs import manhattan
from unifg.scenarios.commands.host import machine
from unifg.scenarios.commands.outcome import Progress
from unifg.solvers.names import TABLE, backend
from unifg.typing import Array

__all__ = ["HISTORY", "SLOWER", "Record", "cases", "compared", "measured", "reference", "self_tests"]

HISTORY = Path(__file__).with_name("performance.jsonl")
SLOWER = 1.15  # times the recorded ratio
QUICK, LONG = 21, 101  # rounds
RESAMPLES = 2000

Action: TypeAlias = Callable[[], object]


@dataclass(frozen=True)
class Record:
    """Result of one measurement.

    Attributes:
        version: of unifg.
        when: ISO date.
        machine: kind: processor, Python and what compiles.
        milliseconds: medians by case, and of the reference.
        ratios: of every round to the reference, by case.
    """

    version: str
    when: str
    machine: str
    milliseconds: dict[str, float]
    ratios: dict[str, list[float]]


def reference() -> float:
    """A little of everything that a solve is made of, the same everywhere."""
    total = 0.0
    for k in range(12000):
        total += (k % 7) * 0.5
    matrix = np.eye(48) * 4.0 + np.add.outer(np.arange(48.0), np.arange(48.0)) / 48.0
    for _ in range(12):
        total += float(np.linalg.solve(matrix, matrix[0])[0])
        total += float(np.sin(matrix).sum())
    return total


def self_tests() -> Iterator[tuple[str, Callable[[], fg.Solution], float]]:
    """For every backend a problem it can take, of kernels that ship: name, solve, and the cost that is right."""
    for name, entry in TABLE.items():
        graph, guess, cost = _ring() if entry.made_by.constraints == "none" else _rim()
        solver: Any = entry.made_by()
        yield name, partial(solver.solve, graph, guess), cost


def _ring() -> tuple[fg.Graph, dict[fg.Family, Array], float]:
    """Eight poses on a circle that close without contradiction."""
    graph, count = fg.Graph(), 8
    x = graph.variables("x", fg.SE2, count)
    step = np.array([1.0, 0.0, 2.0 * np.pi / count])
    truth = [np.zeros(3)]
    while len(truth) < count:
        truth.append(fg.SE2.compose(truth[-1], step))
    graph.fix(x[0], truth[0])
    graph.minimize(fg.between, x[:-1], x[1:], step, sigma=0.1, robust=fg.TruncatedLeastSquares(3.0), name="steps")
    graph.minimize(fg.between, x[-1], x[0], step, sigma=0.1, name="closure")
    return graph, {x: 0.98 * np.array(truth)}, 0.0


def _rim() -> tuple[fg.Graph, dict[fg.Family, Array], float]:
    """The pose on a disc nearest to one outside."""
    graph = fg.Graph()
    x = graph.variables("x", fg.SE2, 1)
    graph.minimize(fg.prior, x, [1.0, 1.0, 0.0], name="wish")
    graph.constrain(obstacles.disc_clearance, x, [[0.0, 0.0]], [1.0], upper=0.0, name="rim")
    return graph, {x: np.array([[0.6, 0.9, 0.1]])}, 0.5 * (np.sqrt(2.0) - 1.0) ** 2


def cases() -> dict[str, Action]:
    """Actions of some milliseconds by name, each run once beforehand, so that nothing compiles later."""
    found: dict[str, Action] = {f"backend {name}": solve for name, solve, _ in self_tests()}
    found |= {f"tick {name}": _tick(name) for name in ("ipm", "alm", "sqp")}
    graph, x, guess = manhattan(300).pose_graph.graph()
    city, hurried = backend("lm").prepare(graph), backend("lm", max_iterations=2).prepare(graph)
    found |= {
        "pose graph": lambda: city.solve(guess),
        "covariances": lambda: hurried.solve(guess).marginals(x),
        "smoothing": _smooth,
        "statement": lambda: _drive()[0].compile(),
    }
    for action in found.values():
        action()
    return found


def _drive() -> tuple[fg.Graph, fg.Data, dict[fg.Family, Array]]:
    """A unicycle that keeps off a disc."""
    graph, nodes, dt = fg.Graph(), 30, 0.1
    x, u = graph.variables("x", fg.SE2, nodes + 1), graph.variables("u", fg.Rn(2), nodes)
    here = graph.data("here", [0.0, 0.0, 0.0])
    graph.fix(x[0], here)
    graph.minimize(fg.prior, x[1:], [2.5, 0.4, 0.0], sigma=1.0, name="goal")
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
    graph.constrain(obstacles.disc_clearance, x[1:], [[1.2, 0.1]], [0.3], lower=0, name="disc")
    graph.bound(u, lower=-1.5, upper=1.5, name="limits")
    controls = np.tile([0.8, 0.1], (nodes, 1))
    return graph, here, {x: unicycle.rollout(np.zeros(3), controls, dt), u: controls}


def _tick(name: str) -> Action:
    """Five ticks from a solution, each a little ahead."""
    graph, here, guess = _drive()
    run = backend(name, tolerance=1e-4).prepare(graph)
    start = run.solve(guess)

    def ticks() -> None:
        last: Any = start
        for k in range(5):
            last = run.solve(last, data={here: [0.02 * k, 0.01 * k, 0.0]})

    return ticks


def _smooth() -> None:
    """Fifteen updates of an incremental estimate."""
    smoother = fg.Incremental()
    x = smoother.variables("x", fg.SE2)
    for k in range(15):
        pose = [0.5 * k, 0.0, 0.0]
        if k == 0:
            smoother.minimize(fg.prior, x[0], pose, sigma=0.1)
        else:
            smoother.minimize(fg.between, x[k - 1], x[k], [0.5, 0.0, 0.0], sigma=0.1)
        smoother.update({x: pose})


def measured(rounds: int, progress: Progress) -> Record:
    """Time everything, in turn, each beside the reference."""
    progress(0.0, "compiling")
    found, rng = cases(), np.random.default_rng(0)
    ratios: dict[str, list[float]] = {name: [] for name in found}
    spent: dict[str, list[float]] = {name: [] for name in ("reference", *found)}
    for k in range(rounds):
        progress(k / rounds, f"round {k + 1} of {rounds}")
        for name in rng.permutation(list(found)):
            ratio, took, usual = beside_reference(found[name])
            ratios[name].append(ratio)
            spent[name].append(took)
            spent["reference"].append(usual)
    progress(1.0, "done")
    milliseconds = {name: round(1e3 * float(np.median(times)), 4) for name, times in spent.items()}
    return Record(fg.__version__, datetime.now(UTC).date().isoformat(), machine(), milliseconds, ratios)


def beside_reference(action: Action) -> tuple[float, float, float]:
    """Ratio of a call to the reference right before and after it, and processor times of both [s]."""
    times = []
    for call in (reference, action, reference):
        began = time.process_time()
        call()
        times.append(time.process_time() - began)
    usual = 0.5 * (times[0] + times[2])
    return times[1] / usual, times[1], usual


def history(file: Path = HISTORY) -> list[Record]:
    """Records on file, the oldest first.

    Raises:
        ScenarioError: for a line that is none.
    """
    try:
        lines = file.read_bytes().splitlines()
    except OSError as error:
        raise ScenarioError(f"{file}: cannot be read ({error.strerror})") from error
    try:
        records = [Record(**json.loads(line)) for line in lines if line.strip()]
        ratios = [np.array(row, dtype=np.float64) for record in records for row in record.ratios.values()]
        positive = all(row.ndim == 1 and row.size and (row > 0.0).all() for row in ratios)
    except (ValueError, TypeError, AttributeError) as error:
        raise ScenarioError(f"{file}: holds a line that is no record of `unifg bench` ({error})") from error
    if not positive:
        raise ScenarioError(f"{file}: holds a line that is no record of `unifg bench` (ratios are positive)")
    return records


def append(file: Path, record: Record) -> None:
    """Add a record to a file.

    Raises:
        ScenarioError: when it cannot be written.
    """
    try:
        with file.open("a", encoding="utf-8") as opened:
            rounded = {name: [round(value, 4) for value in row] for name, row in record.ratios.items()}
            opened.write(json.dumps(asdict(record) | {"ratios": rounded}) + "\n")
    except OSError as error:
        raise ScenarioError(f"{file}: cannot be written ({error.strerror})") from error


def last(records: list[Record], kind: str | None = None) -> Record | None:
    """The newest record, of one kind of machine if that is named."""
    return next((record for record in reversed(records) if kind in (None, record.machine)), None)


class Comparison(NamedTuple):
    """Ratio of the medians of a case now and before, above one where it is slower now, and its 95 % interval."""

    factor: float
    low: float
    high: float

    @property
    def slower(self) -> bool:
        """True beyond doubt."""
        return self.low > SLOWER


def compared(now: Record, then: Record) -> dict[str, Comparison]:
    """Comparisons of the cases that both records have."""
    rows = {}
    for name in sorted(now.ratios.keys() & then.ratios.keys()):
        both = np.array(now.ratios[name]), np.array(then.ratios[name])
        factor = float(_ratio_of_medians(*both))
        low = high = factor
        if min(map(len, both)) > 1:
            found = bootstrap(both, _ratio_of_medians, n_resamples=RESAMPLES, method="percentile", rng=0)
            low, high = map(float, found.confidence_interval)
        rows[name] = Comparison(factor, low, high)
    return rows


def _ratio_of_medians(new: Array, old: Array, axis: int = -1) -> Array:
    return np.asarray(np.median(new, axis=axis) / np.median(old, axis=axis))


def report(now: Record, rows: Mapping[str, Comparison]) -> str:
    """Table: time, times the reference, and that over the record."""
    lines = [f"{'case':18} {'ms':>9} {'x reference':>12}  over the record"]
    for name, ratios in now.ratios.items():
        against = "{:.2f} ({:.2f} to {:.2f})".format(*rows[name]) if name in rows else "-"
        mark = "  SLOWER" if name in rows and rows[name].slower else ""
        lines.append(f"{name:18} {now.milliseconds[name]:9.3f} {float(np.median(ratios)):12.3f}  {against}{mark}")
    return "\n".join(lines)
