"""Code that decides on numbers that are not known: run once for every way through it.

A compiled function of one element may say ``if``. Each run takes one way; what the runs return is chosen among, at run
time, by the conditions that were asked. A condition that knows no variable and no parameter is settled by what it is
where all tangent coordinates are zero.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import TraceError
from unifg.factors.autodiff.tape import Tape

WAYS = 64
"""Ways through a function that are followed, at most."""
DECISIONS = 200
"""Decisions of one way, at most: a loop that ends when a number is small has no end here."""


def every_way(tape: Tape, run: Callable[[], Sequence[int]]) -> list[int]:
    """Nodes of what a function returns, whichever way it goes.

    Args:
        tape: it writes on.
        run: the function, which returns as many nodes whatever is decided.

    Raises:
        TraceError: there are too many ways, or too many decisions on one of them.
    """
    before, runs = tape.decide, 0

    def below(given: list[tuple[int, bool]]) -> list[int]:
        nonlocal runs
        runs += 1
        if runs > WAYS:
            raise TraceError(f"decides on values in more than {WAYS} ways; write np.where(condition, a, b) for some")
        path, known = list(given), dict(given)

        def decide(condition: int) -> bool:
            if tape.op[condition] == Op.NOT:
                return not decide(tape.a[condition])
            if condition not in known:
                settled = at_zero(tape, condition)
                if settled is not None:
                    return settled
                if len(path) >= DECISIONS:
                    raise TraceError("decides on values without end; give the loop a fixed number of turns")
                known[condition] = True
                path.append((condition, True))
            return known[condition]

        tape.decide = decide
        found = list(run())
        for k in reversed(range(len(given), len(path))):
            other = below([*path[:k], (path[k][0], False)])
            found = [tape.select(path[k][0], a, b) for a, b in zip(found, other, strict=True)]
        return found

    try:
        return below([])
    finally:
        tape.decide = before


def at_zero(tape: Tape, condition: int) -> bool | None:
    """Test whether a condition holds where all tangent coordinates are zero; None where that alone does not say."""
    rest, (node,) = tape.at_rest([condition])
    return rest.value[node] != 0.0 if rest.is_constant(node) else None
