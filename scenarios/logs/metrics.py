"""Numbers of runs: statistics of declared columns, and the JSON file they end in.

Everything measured by a clock lives under keys that end in ``_ms``; the rest depends on settings and seed alone, so two
runs of the same seed have the same numbers there.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from unifg.atomic_write import write_atomically
from unifg.scenarios.logs.columns import columns
from unifg.solution.history import subproblems
from unifg.solution.solution import Solution
from unifg.typing import Array, IntArray

__all__ = [
    "collision_words",
    "errors",
    "health",
    "iterations",
    "of_solution",
    "one_graph",
    "spread",
    "statistics",
    "strict",
    "table",
    "timing",
    "write_metrics",
]


def statistics(log: Any) -> dict[str, dict[str, float]]:
    """Statistics of the declared columns that speak for themselves: times in ms, and iterations."""
    made: dict[str, Callable[[Any], dict[str, float]]] = {"ms": timing, "iterations": iterations}
    return {name: made[c.unit](getattr(log, name)) for name, c in columns(log).items() if c.unit in made}


def spread(values: Array) -> dict[str, float]:
    """Mean, standard deviation and maximum."""
    return {"mean": float(np.mean(values)), "std": float(np.std(values)), "max": float(np.max(values))}


def errors(values: Array) -> dict[str, float]:
    """Root mean square and greatest norm of rows (n, d)."""
    norms = np.linalg.norm(values, axis=1)
    return {"rms": math.sqrt(float(np.mean(norms**2))), "max": float(norms.max())}


def timing(values: Array) -> dict[str, float]:
    """Percentiles and maximum."""
    p50, p99 = np.percentile(values, [50.0, 99.0])
    return {"p50": float(p50), "p99": float(p99), "max": float(np.max(values))}


def iterations(values: IntArray) -> dict[str, float]:
    """Mean and maximum of counts."""
    return {"mean": float(np.mean(values)), "max": int(np.max(values))}


def collision_words(count: int) -> str:
    """Number of collisions in words."""
    return "no collision" if count == 0 else f"{count} collision{'s' if count > 1 else ''}"


def one_graph(coupling: object) -> str:
    """Part of a title, where estimation and control are joined."""
    return ", one graph estimates and plans" if coupling == "joint" else ""


def of_solution(solution: Solution) -> dict[str, Any]:
    """Status, cost, KKT numbers and time of a solve."""
    return {
        "status": solution.status.name.lower(),
        "converged": solution.converged,
        "cost": float(solution.cost),
        "iterations": solution.iterations,
        "subproblems": subproblems(solution.history),
        "stationarity": float(solution.stationarity),
        "violation": float(solution.violation),
        "complementarity": float(solution.complementarity),
        "solve_ms": 1e3 * solution.seconds,
    }


def write_metrics(path: str | Path, metrics: Mapping[str, object]) -> Path:
    """Write metrics as JSON with sorted keys; a number that is not finite becomes null.

    Args:
        path: file to write; an existing one is replaced.
        metrics: numbers, words, and lists and mappings of them.

    Returns:
        The path written.
    """
    path = Path(path)
    text = json.dumps(strict(metrics), indent=2, sort_keys=True, allow_nan=False)
    write_atomically(path, text + "\n")
    return path


def strict(value: object, unclear: list[str] | None = None, path: str = "") -> Any:
    """The same value for a strict JSON reader, which knows neither NaN nor infinity: such numbers are None.

    Args:
        value: numbers of Python or NumPy, words, lists and mappings of them; anything else becomes its text.
        unclear: receives the paths of numbers that are not finite.
        path: of the value.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(name): strict(inner, unclear, f"{path}.{name}".lstrip(".")) for name, inner in value.items()}
    if isinstance(value, list | tuple):
        return [strict(inner, unclear, f"{path}.{number}") for number, inner in enumerate(value)]
    if isinstance(value, float) and not math.isfinite(value):
        if unclear is not None:
            unclear.append(path)
        return None
    return value if value is None or isinstance(value, str | bool | int | float) else str(value)


def table(rows: Iterable[Sequence[str]]) -> str:
    """Rows of cells for people, in columns as wide as need be; rows of a name and nothing else are left out."""
    shown = [row for row in rows if any(row[1:])]
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    lines = ("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)) for row in shown)
    return "\n".join(line.rstrip() for line in lines)


def health(m: Mapping[str, Any]) -> str:
    """Health of a run in words, with the causes that lasted longest."""
    ticks = [f"{count} ticks {state}" for state, count in m["health"].items() if count and state != "ok"]
    if not ticks:
        return "ok throughout"
    causes = sorted(m["causes"], key=lambda cause: -m["causes"][cause])[:2]
    return f"{', '.join(ticks)} ({'; '.join(causes)})"
