"""Episodes of a campaign as tables of pandas: one row each, with labels, outcome and every measure that is a number."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import cycle, product
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from unifg.scenarios.campaigns.campaign import episodes_of, manifest_of
from unifg.scenarios.campaigns.task import ERROR, FAILED, LOST, OK
from unifg.typing import Array

__all__ = ["OUTCOMES", "Combination", "Sheet", "load", "sheet_of"]

OUTCOMES = (OK, FAILED, ERROR, LOST)
Combination: TypeAlias = tuple[str, ...]
"""A label for each axis."""


@dataclass
class Sheet:
    """A campaign read.

    Attributes:
        folder: it was read from.
        title: of it.
        axes: names with their labels.
        compare: axes whose values are compared.
        stated: measures that come first.
        code: digest of the code that ran it last.
        expected: number of episodes it has.
        episodes: "combination", "seed", "key", "outcome" and "why" of each, in the order of the file.
        values: of every measure that is a number, by the same index; NaN where an episode has none.
        succeeded_only: whether numbers are those of episodes that are ok.
        seconds: of all episodes together, by the clocks of their machines.
        cpu_seconds: the same by their processors.
        others: rows that were left out because other code ran them.
        unreadable: lines that hold no row.
    """

    folder: Path
    title: str
    axes: dict[str, list[str]]
    compare: list[str]
    stated: list[str]
    code: str
    expected: int
    episodes: pd.DataFrame
    values: pd.DataFrame
    succeeded_only: bool = False
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    others: int = 0
    unreadable: list[int] = field(default_factory=list)

    @property
    def combinations(self) -> list[Combination]:
        """Combinations of labels that have episodes, in the order of the axes."""
        found = set(self.episodes["combination"])
        return [labels for labels in product(*self.axes.values()) if labels in found]

    def of(self, combination: Combination) -> pd.DataFrame:
        """Episodes of a combination."""
        return self.episodes[self.episodes["combination"] == combination]

    def column(self, measure: str, combination: Combination, outcome: str | None = None) -> Array:
        """(n,) numbers of a measure, of all episodes or of those that ended in one way."""
        mine = self.of(combination)
        mine = mine if outcome is None else mine[mine["outcome"] == outcome]
        return np.asarray(self.by_episode(measure).reindex(mine.index).dropna(), dtype=np.float64)

    def by_episode(self, measure: str) -> pd.Series[float]:
        """Numbers of a measure by episode; empty for one that no episode has."""
        return self.values[measure] if measure in self.values else pd.Series(dtype=float)

    def counts(self, combination: Combination) -> Counter[str]:
        """Endings of the episodes of a combination."""
        return Counter(self.of(combination)["outcome"])

    @property
    def failures(self) -> pd.DataFrame:
        """Episodes that did not do what was asked."""
        return self.episodes[self.episodes["outcome"] != OK]

    @property
    def measures(self) -> list[str]:
        """All of them: those that were stated, then those that differ from episode to episode."""
        first = [name for name in self.stated if name in self.values]
        return [*first, *(str(name) for name in self.values if name not in first and self.values[name].nunique() > 1)]


def load(folder: Path, any_code: bool = False, failed_too: bool = False) -> Sheet:
    """Read a campaign.

    Args:
        folder: of the campaign.
        any_code: rows of all states of the code count, the later of two that are the same episode.
        failed_too: numbers of failed episodes are kept even if the campaign's reports leave them out.

    Raises:
        ScenarioError: there is none.
    """
    kept = manifest_of(folder)
    axes, unreadable = kept["axes"], list[int]()
    # Rows have the labels of the day on which they ran: those of today are the manifest's, whose keys go seed by seed.
    labels = dict(zip(kept["keys"], cycle(dict(zip(axes, each, strict=True)) for each in product(*axes.values()))))
    rows = [row | {"labels": labels[row["key"]]} for row in episodes_of(folder, unreadable) if row["key"] in labels]
    mine = [row for row in rows if any_code or row.get("code") == kept["code"]]
    sheet = sheet_of(folder, kept, mine, failed_too)
    sheet.others, sheet.unreadable = len(rows) - len(mine), unreadable
    return sheet


def sheet_of(folder: Path, kept: Mapping[str, Any], rows: list[dict[str, Any]], failed_too: bool = False) -> Sheet:
    """Tables of a campaign's rows.

    Args:
        folder: of the campaign.
        kept: what its manifest holds.
        rows: as its file holds them; the later of two with one key counts.
        failed_too: as in :func:`load`.
    """
    given, axes = kept["campaign"], kept["axes"]
    stated = list(given.get("measures", []))
    succeeded_only = not failed_too and bool(given.get("succeeded_only", False))
    measured = (OK,) if succeeded_only else (OK, FAILED)
    episodes = pd.DataFrame(
        {
            "combination": [tuple(str(row["labels"].get(axis, "")) for axis in axes) for row in rows],
            "seed": pd.Series([row.get("seed") for row in rows], dtype=object),
            "key": [str(row["key"]) for row in rows],
            "outcome": [str(row.get("outcome")) for row in rows],
            "why": [str(row.get("error") or _complaints(row.get("metrics") or {}, stated)) for row in rows],
        }
    )
    numbers = [dict(_numbers(row.get("metrics") or {})) if row.get("outcome") in measured else {} for row in rows]
    last = ~episodes.duplicated("key", keep="last")
    values = pd.DataFrame(numbers, index=episodes.index)[last].dropna(axis="columns", how="all")
    seconds, cpu = (sum(float(row.get(name, 0.0)) for row in rows) for name in ("seconds", "cpu_seconds"))
    return Sheet(
        folder, str(given.get("title", folder.name)), axes, list(kept["compare"]), stated, kept["code"],
        len(kept["keys"]), episodes[last], values, succeeded_only, seconds, cpu,
    )  # fmt: skip


def _numbers(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Numbers inside metrics by their path; flags are 0 or 1, lists of numbers and settings are left out."""
    if isinstance(value, dict):
        for name, inner in value.items():
            if name != "settings":
                yield from _numbers(inner, f"{path}.{name}" if path else name)
    elif isinstance(value, list) and value and all(isinstance(inner, dict) for inner in value):
        for number, inner in enumerate(value):
            yield from _numbers(inner, f"{path}.{number}" if len(value) > 1 else path)
    elif isinstance(value, bool | int | float) and path.rpartition(".")[2] != "seed":
        yield path, float(value)


def _complaints(metrics: Mapping[str, Any], stated: list[str]) -> str:
    """Metrics that explain a failure: flags that are off, things that were hit, measures that were stated."""
    said = list[str]()
    for name, value in metrics.items():
        if name == "outcomes" or (value is False and name not in ("succeeded", "interrupted")):
            said.append(f"{name}: {value if not isinstance(value, bool) else 'no'}")
        elif name in ("collisions", "goals_reached", "status") or (name in stated and isinstance(value, str)):
            said.append(f"{name}: {value}")
    return ", ".join(said)
