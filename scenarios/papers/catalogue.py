"""Tables and figures of the four papers that ``unifg reproduce`` computes again, and the functions that do it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from unifg.errors import ScenarioError
from unifg.scenarios.papers.comparison import Comparison, Effort
from unifg.scenarios.papers.printed import printed

__all__ = ["PAPERS", "Item", "found", "listed"]


@dataclass(frozen=True)
class Item:
    """Table or figure.

    Attributes:
        kind: "table" or "figure".
        number: as the paper has it.
        summary: its content.
        full: runs of ``--full``, and about how long they take.
    """

    kind: str
    number: str
    summary: str
    full: str

    @property
    def option(self) -> str:
        """Option that names it."""
        return f"--{self.kind} {self.number}"


PAPERS = {
    "bazzana": (
        Item("table", "I", "length and duration of eight legs of a department", "30 runs a leg, two bases, two hours"),
        Item("table", "II", "length and duration of four legs of a factory", "30 runs a leg, two bases, an hour"),
        Item("table", "III", "six control problems: cost, iterations, time", "15 rounds, a minute"),
        Item("figure", "6", "error of localisation", "30 runs of eight legs, those of Table I"),
        Item("figure", "7", "manoeuvres: a cusp, and a turn past an obstacle", "two solves, seconds"),
    ),
    "ta": (
        Item("figure", "3", "optimal control past three walls and a cylinder", "200 layouts, minutes"),
        Item("figure", "5", "estimation and control through unknown cylinders", "50 flights, ten minutes"),
    ),
    "factormpc": (
        Item("figure", "5", "distance from a cylinder against alpha", "20 flights for each, minutes"),
        Item("figure", "6", "distance from a moving sphere against gamma", "20 flights for each, minutes"),
        Item("figure", "7", "times with and without barriers, at 100 Hz", "10 flights each, minutes"),
        Item("figure", "8", "flights among many obstacles", "100 flights, a quarter of an hour"),
        Item("figure", "10", "figure eights beside control by flatness", "10 flights for each speed, minutes"),
        Item("figure", "11", "a thrown ball", "11 throws, a minute"),
    ),
    "ecg2o": (
        Item("table", "1", "iterations of the second case study", "six starts, seconds"),
        Item("figure", "3", "iterations of the first case study", "one solve for each length, seconds"),
        Item("figure", "4", "time per iteration of the first case study", "1000 solves, a minute"),
        Item("figure", "5", "inner iterations of the second case study", "six starts, seconds"),
    ),
}  # fmt: skip
"""Items of each paper, whose module of this package has a function ``kind_number`` for each of them."""


def listed(name: str | None = None) -> str:
    """Tables and figures of one paper, or of all of them, with the options that compute them.

    Args:
        name: of the paper.

    Raises:
        ScenarioError: there is no such paper.
    """
    lines = list[str]()
    for paper in PAPERS if name is None else [name]:
        items = [f"  {item.option:11}  {item.summary} (--full: {item.full})" for item in _items(paper)]
        lines += [f"{paper}: {printed()[paper]['title']}", *items]
    return "\n".join(lines)


def found(name: str, kind: str, number: str) -> Callable[[Effort], Comparison]:
    """Function that computes a table or figure again.

    Args:
        name: of the paper.
        kind: "table" or "figure".
        number: as the paper has it; I and 1 are different.

    Raises:
        ScenarioError: there is no such paper, table or figure.
    """
    items = _items(name)
    if not any((item.kind, item.number.lower()) == (kind, number.lower()) for item in items):
        there = ", ".join(item.option for item in items)
        raise ScenarioError(f"{name} has no {kind} {number!r} that can be reproduced; there are {there}")
    function: Callable[[Effort], Comparison] = getattr(
        import_module(f"unifg.scenarios.papers.{name}"), f"{kind}_{number.lower()}"
    )
    return function


def _items(name: str) -> tuple[Item, ...]:
    if name not in PAPERS:
        raise ScenarioError(f"there is no paper {name!r} that can be reproduced; there are {', '.join(PAPERS)}")
    return PAPERS[name]
