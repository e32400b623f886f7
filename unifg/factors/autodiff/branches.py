"""Code that decides on numbers that are not known: run once for every way through it.

A compiled function of one element may say ``if``. Each run takes one way; what the runs return is chosen among, at run
time, by the conditions that were asked. A condition that knows no variable and no parameter is settled by what it is
where all tangent coordinates are zero.

A batched function may assert something about numbers, or raise an exception for some of them. Of two ways of which one
ends with an exception the other is the trace, and its condition is required: solvers test it at every answer.
"""

from __future__ import annotations

import dis
import sys
from collections.abc import Callable, Sequence
from functools import lru_cache
from types import CodeType, TracebackType
from typing import Any

from unifg.factors.autodiff.operations import Op
from unifg.factors.autodiff.symbols import DECIDES, TraceError
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


# ---------------------------------------------------------------- assertions


class _Undecided(BaseException):
    """A condition that was met; functions that handle exceptions are not traced."""

    def __init__(self, condition: int) -> None:
        super().__init__(condition)
        self.condition = condition


class _Raised(Exception):
    """Every way from here ends with an exception, which is the cause."""


def unless_raised(tape: Tape, run: Callable[[], Any]) -> Any:
    """Result of a function where it raises no exception; the conditions for that stand in ``tape.required``.

    Args:
        tape: it writes on.
        run: the function.

    Raises:
        TraceError: two ways return, so that a condition is a decision and no demand.
        Exception: of the function, where it raises one whatever the numbers are.
    """
    before, begin, runs = tape.decide, len(tape.required), 0

    def once(known: dict[int, bool], decision: int = -1) -> Any:
        nonlocal runs
        runs += 1
        if runs > 4 * WAYS:
            raise TraceError(f"asserts more than {WAYS} things about numbers")

        def decide(condition: int) -> bool:
            if tape.op[condition] == Op.NOT:
                return not decide(tape.a[condition])
            if condition == decision:
                raise TraceError(DECIDES)
            if condition not in known:
                raise _Undecided(condition)
            return known[condition]

        del tape.required[begin:]
        tape.decide = decide
        try:
            return run()
        except Exception as error:
            if _bound_to_raise(error.__traceback__):
                raise _Raised from error
            raise

    def follow(known: dict[int, bool]) -> tuple[Any, list[int]]:
        try:
            return once(known), tape.required[begin:]
        except _Undecided as undecided:
            condition = undecided.condition
        try:
            found, required = follow({**known, condition: False})
        except _Raised:
            found, required = follow({**known, condition: True})
            return found, [*required, condition]
        if returns({**known, condition: True}):
            once(known, condition)
        return found, [*required, tape.apply(Op.NOT, condition)]

    def returns(known: dict[int, bool]) -> bool:
        try:
            once(known)
        except _Undecided as undecided:
            return any(returns({**known, undecided.condition: answer}) for answer in (False, True))
        except _Raised:
            return False
        return True

    try:
        found, required = follow({})
    except _Raised as error:
        raise error.__cause__ or error from None
    finally:
        tape.decide = before
    tape.required[begin:] = required
    return found


def innermost(trace: TracebackType | None) -> TracebackType | None:
    """The innermost place of the user's own code that was running; None where there is none."""
    own = None
    while trace is not None:
        code, names = trace.tb_frame.f_code, trace.tb_frame.f_globals
        package = str(names.get("__name__", "")).partition(".")[0]
        if package != "unifg" and package not in sys.stdlib_module_names and not _installed(code.co_filename):
            own = trace
        trace = trace.tb_next
    return own


def _installed(path: str) -> bool:
    """Test whether a file belongs to a package that somebody has installed, or to what is compiled."""
    return "site-packages" in path or "dist-packages" in path or path.endswith(".pyx")


def _bound_to_raise(trace: TracebackType | None) -> bool:
    """Test whether the user's code that was running could only end with an exception."""
    running = innermost(trace)
    return running is not None and _never_returns(running.tb_frame.f_code, running.tb_lasti)


@lru_cache(maxsize=1024)
def _never_returns(code: CodeType, offset: int) -> bool:
    """Test whether no way from an instruction leads to the end of a function."""
    steps = {step.offset: step for step in dis.get_instructions(code)}
    after = dict(zip(steps, [*steps][1:], strict=False))
    waiting, seen = [max(k for k in steps if k <= offset)], set[int]()  # it may be in what follows an instruction
    while waiting:
        step = steps[waiting.pop()]
        if step.opname.startswith(("RETURN", "YIELD")):
            return False
        if step.offset in seen or step.opname in ("RAISE_VARARGS", "RERAISE"):
            continue
        seen.add(step.offset)
        if step.opcode in dis.hasjrel or step.opcode in dis.hasjabs:
            waiting.append(int(step.argval))
        if step.offset in after and step.opname not in ("JUMP_FORWARD", "JUMP_BACKWARD", "JUMP_BACKWARD_NO_INTERRUPT"):
            waiting.append(after[step.offset])
    return True
