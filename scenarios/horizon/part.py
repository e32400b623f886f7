"""What a horizon says, in parts: each states its terms in one place and returns what gives their data at every tick."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np

import unifg as fg
from unifg.typing import Array, ArrayLike


@dataclass(frozen=True)
class Now:
    """What the parts of any horizon may ask for at a tick; robots add their own.

    Attributes:
        present: (storage,) state by the past alone.
        wanted: (N, m) controls, or (m,) for the same at all stages.
        last: (m,) control that was applied last.
    """

    present: Array
    wanted: Array
    last: Array


Asked = TypeVar("Asked", bound=Now)
Given: TypeAlias = dict[fg.Data, ArrayLike]
Gives: TypeAlias = Callable[[Asked], Given]
"""Data of a tick."""
Part: TypeAlias = Callable[[fg.Graph, fg.Family, fg.Family], Gives[Asked]]
"""``part(graph, x, u)`` adds terms of states x (N + 1) and controls u (N); returns what gives the data they need."""


def stated(parts: Sequence[Part[Asked]], graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Asked]:
    """State several parts, in their order; returns what gives the data of all."""
    all_gives = [part(graph, x, u) for part in parts]

    def data(now: Asked) -> Given:
        found: Given = {}
        for give in all_gives:
            found |= give(now)
        return found

    return data


def known_present(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Now]:
    """The present is given: the first state is fixed to it."""
    start = graph.data("start", x.manifold.identity())
    graph.fix(x[0], start)
    return lambda now: {start: now.present}


def effort(sigma: ArrayLike, change: ArrayLike) -> Part[Now]:
    """Costs of controls: how far they are from those wanted, and how they change, the one applied last included.

    Args:
        sigma: (m,) standard deviations of the first.
        change: (m,) of the second.
    """

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Now]:
        shape = len(u), u.manifold.storage
        wanted = graph.data("wanted controls", np.zeros(shape), each=True)
        last = graph.data("last control", np.zeros(shape[1]))
        graph.minimize(fg.prior, u, wanted, sigma=sigma, name="effort")
        graph.minimize(fg.prior, u[0], last, sigma=change, name="first change")
        graph.minimize(fg.difference, u[:-1], u[1:], sigma=change, name="change")
        return lambda now: {wanted: np.broadcast_to(now.wanted, shape), last: now.last}

    return state
