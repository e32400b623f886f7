"""Factors of a smoother as arrays, for modules that judge what it holds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from unifg.factors.kernel import Kernel
from unifg.factors.robust import QUADRATIC
from unifg.factors.whitening import DIAGONAL, FULL
from unifg.smoothing.incremental import Incremental
from unifg.smoothing.revocable import LEAST
from unifg.typing import Array, BoolArray, IntArray


class Held(NamedTuple):
    """Factors of one type.

    Attributes:
        kernel: their compiled residual; None where Python evaluates it.
        plain: they have no robust loss.
        order: (k,) numbers that increase with the order in which factors were added.
        families: (k, slots) numbers of the families of their variables.
        members: (k, slots).
        parameters: (k, p) of the kernel.
        information: (k, m, m), that of a factor that counts.
        accepted: (k,) False for revocable factors that do not count.
    """

    kernel: Kernel | None
    plain: bool
    order: IntArray
    families: IntArray
    members: IntArray
    parameters: Array
    information: Array
    accepted: BoolArray

    def has(self, kernel: Kernel | None) -> bool:
        """True if a kernel is theirs, or theirs a copy of it."""
        return (
            self.kernel is not None
            and kernel is not None
            and (_code(self.kernel), self.kernel.arguments) == (_code(kernel), kernel.arguments)
        )


def contents(smoother: Incremental) -> list[Held]:
    """All factors of a smoother by type; takes time proportional to their number."""
    with smoother._lock:
        state = smoother._state
        kernels = {number: key[0] for key, number in smoother._types._numbers.items()}
        counting = np.ones(len(state.factors), dtype=np.bool_)
        counting[smoother._revocables.rows] = smoother._revocables.accepted
        used = np.flatnonzero(state.factors["used"])
        types, found = state.factors["type"][used], []
        for number in np.unique(types).tolist():
            rows, kind = used[types == number], state.types[number]
            factors, accepted = state.factors[rows], counting[rows]
            slots = factors["variables"][:, None] + np.arange(kind["slots"])
            variables = state.variables[state.lists[slots]]
            numbers = state.numbers[factors["data"][:, None] + np.arange(kind["numbers"])]
            parameters, whitener = np.split(numbers, [int(kind["parameters"])], axis=1)
            size = int(kind["rows"])
            information = np.tile(np.eye(size), (len(rows), 1, 1))
            if kind["whitening"] & DIAGONAL:
                information *= whitener[:, None] ** 2
            elif kind["whitening"] & FULL:
                roots = whitener.reshape(-1, size, size)
                information = np.swapaxes(roots, 1, 2) @ roots
            information[~accepted] /= LEAST
            found.append(
                Held(
                    kernels[number], bool(kind["loss"] == QUADRATIC), rows, variables["family"], variables["member"],
                    parameters, information, accepted,
                )
            )  # fmt: skip
        return found


def _code(kernel: Kernel) -> object:
    """Function that a kernel and its copies share."""
    return getattr(kernel, "written", kernel.function)
