"""A section of the page of elimination: its measurement, its goals and its rendering."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from benchmarks.timing import Spread

Result: TypeAlias = dict[str, Any]
"""What JSON can hold."""


class Section(NamedTuple):
    """One part of the page.

    Attributes:
        title: its heading.
        measure: (rounds, small) to a result with "rows", "rounds" and "goals".
        render: result to Markdown.
    """

    title: str
    measure: Callable[[int, bool], Result]
    render: Callable[[Result], str]


def goal(name: str, unit: str, value: Spread, target: float, floor: float | None = None) -> Result:
    """Measured value with the target it should reach and the floor it must reach."""
    return {"name": name, "unit": unit, "value": value, "target": target, "floor": floor}


def met(goal: Result, bound: str = "target") -> bool:
    """Test whether the median of a goal reaches its target or floor."""
    if goal[bound] is None:
        return True
    value = goal["value"][0]
    return bool(value >= goal[bound] if goal["unit"].startswith("times faster") else value <= goal[bound])
