"""How fast the elimination engine is: beside GTSAM, with size, in the chains of control, for covariances.

    python -m benchmarks.elimination [--only SECTION ...] [--rounds R]

Everything runs in one thread on one core, candidates in turn (:mod:`benchmarks.timing`). Results go to
docs/benchmarks.json with versions, machine, date and the state of the code, and from there to docs/benchmarks.md, where
the previous run stands beside the new one; fewer than 15 rounds, or no gtsam, are only printed. Exit code 1 when
something is slower than its floor.
"""

from __future__ import annotations

import argparse
import datetime
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from benchmarks import chains, growth, gtsam_peer, marginals, own_residuals, pose_graphs
from benchmarks.report import CHECKOUT, OUT, code_digest, machine, put_results, table
from benchmarks.timing import number, pin, shown

Result: TypeAlias = dict[str, Any]

PAGE, STORE = CHECKOUT / "docs" / "benchmarks.md", CHECKOUT / "docs" / "benchmarks.json"
ENOUGH = 15  # rounds that a published median is made of
PACKAGES = ("unifg", "numpy", "scipy", "numba", "gtsam")


class Section(NamedTuple):
    """One part of the page.

    Attributes:
        title: its heading.
        measure: (rounds, small) to a result that JSON can hold, with ``goals``.
        render: result to Markdown.
    """

    title: str
    measure: Callable[[int, bool], Result]
    render: Callable[[Result], str]


SECTIONS = {
    "pose-graphs": Section("Pose graphs", pose_graphs.measure, pose_graphs.render),
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
        code: digest of the package that was measured.
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


def met(goal: Result, bound: str = "target") -> bool:
    """Whether a goal's median reaches its target or floor."""
    if goal[bound] is None:
        return True
    value = goal["value"][0]
    return bool(value >= goal[bound] if goal["unit"].startswith("times faster") else value <= goal[bound])


def summary(store: Result) -> str:
    """All goals, with the run before."""
    lines = []
    for name in SECTIONS:
        if name not in store:
            continue
        previous = store[name]["previous"]
        for goal in store[name]["result"]["goals"]:
            old = previous["goals"].get(goal["name"]) if previous else None
            lines.append(
                (
                    goal["name"],
                    goal["unit"],
                    _value(goal["value"]),
                    _value(goal["target"]) + ("" if goal["floor"] is None else f" (floor {goal['floor']:g})"),
                    "yes" if met(goal) else "floor only" if goal["floor"] is not None and met(goal, "floor") else "no",
                    "-" if old is None else _value(old),
                )
            )
    head = ("what", "unit", "median (quartiles)", "target", "met", "previous run")
    return table(head, lines, text=2)


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
    lines = []
    for name, section in SECTIONS.items():
        if name in store:
            run, previous = store[name], store[name]["previous"]
            before = "-" if previous is None else f"{previous['date']}, {previous['code']}"
            lines.append(
                (
                    section.title,
                    f"{run['date']}, {run['code']}",
                    before,
                    str(run["result"]["rounds"]),
                    str(run["seconds"]),
                )
            )
    places = dict.fromkeys(store[name]["machine"] for name in SECTIONS if name in store)
    head = ("section", "date and code", "previous run", "rounds", "took [s]")
    return "\n\n".join([table(head, lines, text=3), *places])


def load(path: Path) -> Result:
    """The results so far, none when there is no file."""
    found: Result = json.loads(path.read_text(encoding="utf-8"))["sections"] if path.is_file() else {}
    return found


def main(arguments: list[str] | None = None) -> int:
    """Measure and write; 0 only if every floor is reached."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.elimination", description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=SECTIONS, metavar="SECTION", help=", ".join(SECTIONS))
    parser.add_argument("--rounds", type=int, default=ENOUGH, help="of everything; fewer than 15 are only printed")
    options = parser.parse_args(arguments)
    if not gtsam_peer.available():
        print("gtsam is not installed: no comparison, and the page in docs/ is left alone.")
    pin()
    store, code = load(STORE), code_digest("benchmarks.elimination")
    goals: list[Result] = []
    chosen = options.only or list(SECTIONS)
    for name in chosen:
        print(f"{SECTIONS[name].title} ...", flush=True)
        begin = time.perf_counter()
        result = SECTIONS[name].measure(options.rounds, False)
        record(store, name, result, time.perf_counter() - begin, code)
        goals += result["goals"]
    print(render({name: store[name] for name in chosen}))
    if options.rounds >= ENOUGH and gtsam_peer.available():
        text = json.dumps({"sections": store}, indent=1)
        STORE.write_text(text + "\n", encoding="utf-8", newline="\n")
        OUT.mkdir(parents=True, exist_ok=True)
        (OUT / "elimination.md").write_text(render(store) + "\n", encoding="utf-8", newline="\n")
        put_results(PAGE, "Benchmarks", render(store), {section["code"] for section in store.values()})
    return 0 if all(met(goal, "floor") for goal in goals) else 1


if __name__ == "__main__":
    raise SystemExit(main())
