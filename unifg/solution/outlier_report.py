"""Outlier report: measurements kept and left out by an answer, and answers that compete with it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from unifg.typing import BoolArray, IntArray

NONE = np.zeros(0, dtype=np.intp)
SHOWN = 5  # factors that a sentence names


class Answer(Protocol):
    """Competing solution."""

    @property
    def cost(self) -> float:
        """Objective, with its 1/2."""

    @property
    def verdict(self) -> OutlierReport[Any] | None:
        """Measurements kept."""


AnswerT = TypeVar("AnswerT", bound=Answer)


@dataclass(frozen=True, eq=False)
class Group(Generic[AnswerT]):
    """Measurements between the same stretches that agree with each other, and with little else.

    Attributes:
        term: their term.
        factors: (k,) their positions in it.
        kept: they count in the answer. The others contradict them, though none of them alone.
        other: the answer without them where they count, with them where they do not.
        moved: family, member and distance by which that answer differs most; the longest tangent vector between both.
    """

    term: str
    factors: IntArray
    kept: bool
    other: AnswerT = field(repr=False)
    moved: tuple[str, int, float]

    def sentence(self) -> str:
        """The group and what depends on it."""
        family, member, far = self.moved
        named, which = _named({self.term: self.factors}), f"'{family}' {member} by {far:.3g}"
        how, without = ("Kept, though only they", "without") if self.kept else ("Left out, though they", "with")
        return f"{how} agree with each other: {named}; {without} them, cost {self.other.cost:.6g}, {which}."


@dataclass(frozen=True, eq=False)
class OutlierReport(Generic[AnswerT]):
    """Outlier report of a solve that separates right measurements from wrong ones.

    Attributes:
        kept: (n,) per term with a loss that leaves out: whether a factor counts.
        doubted: factors that count, since they lie within their thresholds, though what they disagree with the others
            by is more than those scatter.
        unit: variance of unit weight: how large the squares of whitened residuals are against what was stated, at
            most one.
        rivals: other answers that were found and believe other measurements: those with a lower cost, as stated, and
            those that keep something else and can hardly be told from this one. Each has a verdict of its own.
        groups: measurements that agree with themselves alone, with what depends on them; up to three that count and
            three that do not. Neither reading is ruled out.
    """

    kept: dict[str, BoolArray]
    flagged: dict[str, IntArray] = field(default_factory=dict)
    unit: float = 1.0
    rivals: tuple[AnswerT, ...] = field(default=(), repr=False)
    groups: tuple[Group[AnswerT], ...] = ()

    @property
    def left_out(self) -> dict[str, IntArray]:
        """Factors that do not count, by term."""
        return {name: np.flatnonzero(~kept) for name, kept in self.kept.items()}

    def __post_init__(self) -> None:
        """Name every term."""
        object.__setattr__(self, "flagged", {name: self.flagged.get(name, NONE) for name in self.kept})

    def sentence(self, cost: float) -> str:
        """Summary of the measurements kept, with a warning if other answers compete.

        Args:
            cost: of the answer this belongs to.
        """
        parts = [f"{int(kept.sum())} of {len(kept)} in '{name}'" for name, kept in self.kept.items()]
        text = f"Kept {', '.join(parts)}; residuals are {self.unit**0.5:.2g} of what was stated."
        if any(len(which) for which in self.flagged.values()):
            text += f" Within their threshold, but further off than the others allow: {_named(self.flagged)}."
        for rival in self.rivals:
            assert rival.verdict is not None
            theirs = rival.verdict.kept
            more = _named({name: np.flatnonzero(theirs[name] & ~kept) for name, kept in self.kept.items()})
            fewer = _named({name: np.flatnonzero(kept & ~theirs[name]) for name, kept in self.kept.items()})
            differs = " and ".join(
                text for text in (f"keeps {more}" if more else "", f"leaves out {fewer}" if fewer else "") if text
            )
            text += f" Another answer costs {rival.cost:.6g} (this one {cost:.6g}): it {differs}."
        return " ".join([text, *(group.sentence() for group in self.groups)])


def _named(factors: dict[str, IntArray]) -> str:
    """Factors counted by term, the first of them by number."""
    parts = []
    for name, which in factors.items():
        listed = ", ".join(map(str, which[:SHOWN].tolist())) + (", ..." if len(which) > SHOWN else "")
        if len(which):
            parts.append(f"{len(which)} in '{name}' ({listed})")
    return ", ".join(parts)
