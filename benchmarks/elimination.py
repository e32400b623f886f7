"""How fast the elimination engine is: beside GTSAM, with size, in the chains of control, for covariances.

    python -m benchmarks.elimination [--only SECTION ...] [--rounds R]

Everything but two threads runs in one thread on one core, candidates in turn (:mod:`benchmarks.timing`). Results go to
docs/benchmarks.json with versions, machine, date and the state of the code, and from there to docs/benchmarks.md, where
the previous run stands beside the new one; fewer than 15 rounds, or no gtsam, are only printed. Exit code 1 when
something is slower than its floor.
"""

from __future__ import annotations

import datetime
import json
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import chains, growth, gtsam_peer, large_fronts, marginals, own_residuals, pose_graphs, two_threads
from benchmarks.report import CHECKOUT, command, commit, listing, machine, publish
from benchmarks.section import Result, Section, met
from benchmarks.timing import number, pin, shown

STORE = CHECKOUT / "docs" / "benchmarks.json"
ENOUGH = 15  # rounds that a published median is made of
PACKAGES = ("unifg", "numpy", "scipy", "numba", "gtsam")

SECTIONS = {
    "pose-graphs": Section("Pose graphs", pose_graphs.measure, pose_graphs.render),
    "two-threads": Section("Two threads", two_threads.measure, two_threads.render),
    "large-fronts": Section("Large fronts", large_fronts.measure, large_fronts.render),
    "growth": Section("Growth with size", growth.measure, growth.render),
    "chains": Section("Chains of control", chains.measure, chains.render),
    "marginals": Section("Marginal covariances", marginals.measure, marginals.render),
    "own-residuals": Section("A residual of one's own", own_residuals.measure, own_residuals.render),
}


def record(store: Result, name: str, result: Result, seconds: float, code: str) -> None:
    """Put a section's result into the store, and keep from the run before what can be compared.

    Args:
        store: all sections; changed.
        name: of the section.
        result: what it measured.
        seconds: it took.
        code: commit that was measured.
    """
    before = store.get(name)
    store[name] = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "code": code,
        "machine": machine(*PACKAGES),
        "seconds": round(seconds),
        "result": result,
        "previous": None
        if before is None
        else {
            "date": before["date"],
            "code": before["code"],
            "goals": {goal["name"]: goal["value"] for goal in before["result"]["goals"]},
        },
    }


GOAL: dict[str, Callable[[Result], str]] = {
    "median (quartiles)": lambda goal: _value(goal["value"]),
    "target": lambda goal: _value(goal["target"]) + ("" if goal["floor"] is None else f" (floor {goal['floor']:g})"),
    "met": lambda goal: (
        "yes" if met(goal) else "floor only" if goal["floor"] is not None and met(goal, "floor") else "no"
    ),
    "previous run": lambda goal: "-" if goal["old"] is None else _value(goal["old"]),
}


def summary(store: Result) -> str:
    """All goals, with the run before."""
    groups: dict[tuple[str, str], Result] = {}
    for section in (store[name] for name in SECTIONS if name in store):
        old = section["previous"]["goals"] if section["previous"] else {}
        groups |= {(g["name"], g["unit"]): {**g, "old": old.get(g["name"])} for g in section["result"]["goals"]}
    return listing(("what", "unit"), groups, GOAL)


def _value(value: float | list[float]) -> str:
    if not isinstance(value, list):
        return f"{value:g}"
    if abs(value[0]) < 1e-5:
        return f"{value[0]:.0e}"
    return number(value[0]) if value[1] == value[2] else shown(value)


def render(store: Result) -> str:
    """The whole page between its markers."""
    parts = [summary(store), _runs(store)]
    for name, section in SECTIONS.items():
        if name in store:
            parts += [f"## {section.title}", section.render(store[name]["result"])]
    return "\n\n".join(parts)


def _runs(store: Result) -> str:
    """When, where and on which code."""

    def when(run: Result | None) -> str:
        return "-" if run is None else f"{run['date']}, {run['code']}"

    runs = {name: run for name, run in store.items() if name in SECTIONS}
    groups = {(SECTIONS[n].title, when(runs[n]), when(runs[n]["previous"])): runs[n] for n in SECTIONS if n in runs}
    columns: dict[str, Callable[[Result], str]] = {
        "rounds": lambda run: str(run["result"]["rounds"]),
        "took [s]": lambda run: str(run["seconds"]),
    }
    told = listing(("section", "date and code", "previous run"), groups, columns)
    return "\n\n".join([told, *dict.fromkeys(run["machine"] for run in groups.values())])


def load(path: Path) -> Result:
    """The results so far, none when there is no file."""
    found: Result = json.loads(path.read_text(encoding="utf-8"))["sections"] if path.is_file() else {}
    return found


def main(arguments: list[str] | None = None) -> int:
    """Measure and write; 0 only if every floor is reached."""
    parser = command(__doc__)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--rounds", type=int, default=ENOUGH, help="of everything; fewer than 15 are only printed")
    options = parser.parse_args(arguments)
    if not gtsam_peer.available():
        print("gtsam is not installed: no comparison, and the page in docs/ is left alone.")
    pin()
    store, code = load(STORE), commit()
    goals: list[Result] = []
    chosen = options.only or list(SECTIONS)
    for name in chosen:
        print(f"{SECTIONS[name].title} ...", flush=True)
        begin = time.perf_counter()
        result = SECTIONS[name].measure(options.rounds, False)
        record(store, name, result, time.perf_counter() - begin, code)
        goals += result["goals"]
    if options.rounds >= ENOUGH and gtsam_peer.available():
        STORE.write_text(json.dumps({"sections": store}, indent=1) + "\n", encoding="utf-8", newline="\n")
        publish("benchmarks", render(store), {section["code"] for section in store.values()})
    else:
        publish("benchmarks", render({name: store[name] for name in chosen}), docs=False)
    return 0 if all(met(goal, "floor") for goal in goals) else 1


if __name__ == "__main__":
    raise SystemExit(main())
