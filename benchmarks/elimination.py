"""Speed of the elimination engine: beside GTSAM, with two threads, in the chains of control, for covariances.

Everything but two threads runs in one thread on one core, contestants in turn (:mod:`benchmarks.timing`). Results are
kept in docs/benchmarks.json, from which the tables are made.
"""

from __future__ import annotations

import json

from benchmarks import chains, marginals, pose_graphs, two_threads
from benchmarks.report import CHECKOUT, Columns, listing
from benchmarks.runner import Timing
from benchmarks.section import Result, Section, met
from benchmarks.timing import number, shown

STORE = CHECKOUT / "docs" / "benchmarks.json"
SECTIONS = {
    "pose-graphs": Section("Pose graphs", pose_graphs.measure, pose_graphs.render),
    "two-threads": Section("Two threads", two_threads.measure, two_threads.render),
    "chains": Section("Chains of control", chains.measure, chains.render),
    "marginals": Section("Marginal covariances", marginals.measure, marginals.render),
}
GOAL: Columns[Result] = {
    "median (bounds)": lambda goal: _value(goal["value"]),
    "target": lambda goal: _value(goal["target"]) + ("" if goal["floor"] is None else f" (floor {goal['floor']:g})"),
    "met": lambda goal: (
        "yes" if met(goal) else "floor only" if goal["floor"] is not None and met(goal, "floor") else "no"
    ),
}


def _value(value: float | list[float]) -> str:
    if not isinstance(value, list):
        return f"{value:g}"
    if abs(value[0]) < 1e-5:
        return f"{value[0]:.0e}"
    return number(value[0]) if value[1] == value[2] else shown(value)


def render(results: dict[str, Result]) -> str:
    """Goals of all sections, then the tables of each."""
    goals = {(goal["name"], goal["unit"]): goal for result in results.values() for goal in result["goals"]}
    parts = [listing(("what", "unit"), goals, GOAL)]
    for name, result in results.items():
        parts += [f"### {SECTIONS[name].title}", SECTIONS[name].render(result)]
    return "\n\n".join(parts)


def tables(rounds: int) -> str:
    """Measure all sections and keep the results."""
    results = {name: section.measure(rounds, False) for name, section in SECTIONS.items()}
    STORE.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8", newline="\n")
    return render(results)


STUDY = Timing(tables)
