"""The rows of a campaign as columns of numbers, one for each measure, by combination of the axes and seed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from unifg.scenarios.campaigns.campaign import EPISODES, manifest_of
from unifg.scenarios.campaigns.journal import lines_of
from unifg.scenarios.campaigns.performed import ERROR, FAILED, LOST, OK
from unifg.typing import Array

__all__ = ["OUTCOMES", "Combination", "Failure", "Sheet", "load"]

OUTCOMES = (OK, FAILED, ERROR, LOST)
Combination: TypeAlias = tuple[str, ...]
"""A label for each axis."""
Seed: TypeAlias = int | None


@dataclass(frozen=True)
class Failure:
    """An episode that did not do what was asked."""

    key: str
    combination: Combination
    seed: Seed
    outcome: str
    why: str


@dataclass
class Sheet:
    """A campaign read.

    Attributes:
        folder: it was read from.
        title: of it.
        axes: names with their labels.
        bundles: axes whose values stand for several settings.
        compare: axes whose values are compared.
        stated: measures that come first.
        succeeded_only: whether numbers are those of episodes that are ok.
        code: digest of the code that ran it last.
        expected: number of episodes it has.
        outcomes: of every episode, by combination and seed.
        keys: likewise.
        values: of every measure that is a number, by combination and seed.
        failures: what did not go well, in the order of the file.
        seconds: of all episodes together, by the clocks of their machines.
        cpu_seconds: the same by their processors.
        others: rows that were left out because other code ran them.
        unreadable: lines that hold no row.
    """

    folder: Path
    title: str
    axes: dict[str, list[str]]
    bundles: list[str]
    compare: list[str]
    stated: list[str]
    succeeded_only: bool
    code: str
    expected: int
    outcomes: dict[Combination, dict[Seed, str]] = field(default_factory=dict)
    keys: dict[tuple[Combination, Seed], str] = field(default_factory=dict)
    values: dict[str, dict[Combination, dict[Seed, float]]] = field(default_factory=dict)
    failures: list[Failure] = field(default_factory=list)
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    others: int = 0
    unreadable: int = 0

    def column(self, measure: str, combination: Combination, outcome: str | None = None) -> Array:
        """(n,) numbers of a measure, of all episodes or of those that ended in one way."""
        ends = self.outcomes.get(combination, {})
        found = self.values.get(measure, {}).get(combination, {})
        return np.array([value for seed, value in found.items() if outcome in (None, ends.get(seed))])

    def counts(self, combination: Combination) -> Counter[str]:
        """How episodes of a combination ended."""
        return Counter(self.outcomes[combination].values())

    @property
    def measures(self) -> list[str]:
        """All of them: those that were stated, then those that differ from episode to episode."""
        first = [name for name in self.stated if name in self.values]
        rest = [name for name in self.values if name not in first and len(set(self._all(name))) > 1]
        return [*first, *rest]

    def _all(self, measure: str) -> Iterator[float]:
        for found in self.values[measure].values():
            yield from found.values()


def load(folder: Path, any_code: bool = False, failed_too: bool = False) -> Sheet:
    """Read a campaign, row by row.

    Args:
        folder: of the campaign.
        any_code: rows of all states of the code count, the later of two that are the same episode.
        failed_too: numbers of failed episodes are kept even if the campaign's reports leave them out.

    Raises:
        ScenarioError: there is none.
    """
    kept = manifest_of(folder)
    given = kept["campaign"]
    keys = set(kept["keys"])
    sheet = Sheet(
        folder, str(given.get("title", folder.name)), kept["axes"], kept["bundles"], kept["compare"],
        list(given.get("measures", [])), not failed_too and bool(given.get("succeeded_only", False)), kept["code"],
        len(keys),
    )  # fmt: skip
    unreadable: list[int] = []
    failures: dict[str, Failure] = {}
    for row in lines_of(folder / EPISODES, unreadable):
        key = str(row.get("key"))
        if key not in keys:
            continue
        if row.get("code") != sheet.code and not any_code:
            sheet.others += 1
            continue
        failures.pop(key, None)
        _take(sheet, key, row, failures)
    sheet.failures, sheet.unreadable = list(failures.values()), len(unreadable)
    order = {labels: k for k, labels in enumerate(_combinations(sheet.axes))}
    sheet.outcomes = dict(sorted(sheet.outcomes.items(), key=lambda item: order.get(item[0], len(order))))
    return sheet


def _take(sheet: Sheet, key: str, row: Mapping[str, Any], failures: dict[str, Failure]) -> None:
    combination, seed = tuple(str(row["labels"].get(axis, "")) for axis in sheet.axes), row.get("seed")
    outcome = str(row.get("outcome"))
    sheet.outcomes.setdefault(combination, {})[seed] = outcome
    sheet.keys[combination, seed] = key
    sheet.seconds += float(row.get("seconds", 0.0))
    sheet.cpu_seconds += float(row.get("cpu_seconds", 0.0))
    metrics = row.get("metrics") or {}
    for found in sheet.values.values():
        found.get(combination, {}).pop(seed, None)  # of an earlier row of the same episode
    if outcome == OK or (outcome == FAILED and not sheet.succeeded_only):
        for name, value in _numbers(metrics):
            sheet.values.setdefault(name, {}).setdefault(combination, {})[seed] = value
    if outcome != OK:
        why = str(row.get("error") or _complaints(metrics, sheet.stated))
        failures[key] = Failure(key, combination, seed, outcome, why)


def _numbers(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Numbers inside metrics by their path; flags are 0 or 1, lists of numbers are left out."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from _numbers(inner, f"{path}.{name}" if path else name)
    elif isinstance(value, list) and value and all(isinstance(inner, dict) for inner in value):
        for number, inner in enumerate(value):
            yield from _numbers(inner, f"{path}.{number}" if len(value) > 1 else path)
    elif isinstance(value, bool | int | float) and path.rpartition(".")[2] != "seed":
        yield path, float(value)


def _complaints(metrics: Mapping[str, Any], stated: list[str]) -> str:
    """What the metrics of a failed episode say: flags that are off, things that were hit, measures that were stated."""
    said = list[str]()
    for name, value in metrics.items():
        if name == "outcomes" or (value is False and name not in ("succeeded", "interrupted")):
            said.append(f"{name}: {value if not isinstance(value, bool) else 'no'}")
        elif name in ("collisions", "goals_reached", "status") or (name in stated and isinstance(value, str)):
            said.append(f"{name}: {value}")
    return ", ".join(said)


def _combinations(axes: Mapping[str, list[str]]) -> Iterator[Combination]:
    from itertools import product

    yield from product(*axes.values())
