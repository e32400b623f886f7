"""Verification of traces at an answer: every traced function is evaluated as it was written, on the whole batch.

Values are compared up to rounding. Derivatives are compared with one-sided difference quotients along one random
direction: the exact slope must lie between them, widened by what two lengths of the step disagree by, so that kinks,
jumps and noise are no differences.

What a function asserts about its arguments is no part of its trace. At every answer compiled code tests the assertions;
where one fails, the function itself is called, and raises its exception.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from unifg.errors import GraphError
from unifg.factors.autodiff.derived import NO_SLOPES
from unifg.factors.kernel import evaluate_rows
from unifg.problem.columns import Values
from unifg.problem.term import CompiledTerm
from unifg.problem.traced import Batch
from unifg.typing import Array, BoolArray, IntArray

LENGTHS = (1e-5, 1e-3, 1e-7)  # of steps [m, rad]; a slope is wrong only where it is by all of them
BESIDE = 1e-6  # where a value is compared again: at one point a function may stand on the edge of a jump
ALIKE = 1e-9  # relative difference of values at which nothing else is looked at
MARGIN = 4.0  # times the disagreement of two steps
RELATIVE = 1e-6  # of a slope
ROUNDINGS = 64.0

Move = Callable[[float], Values]
"""Values after a step of some length along a fixed direction."""


class Verification:
    """Comparison of the trace of a term with its function, with what is needed each time laid out once.

    Attributes:
        term: whose trace it is.
        kernel: of the trace; another kernel makes this void.
        demanding: whether the function asserts something about its arguments.
    """

    def __init__(self, term: CompiledTerm) -> None:
        """Find the places of the arguments."""
        assert term.trace is not None
        self.term, self.kernel = term, term.trace.kernel
        places = [gather.places(start) for gather, start in zip(term.gathers, term.starts, strict=True)]
        self._places: IntArray = np.concatenate(places, axis=1)
        self._columns: IntArray = np.concatenate(term.columns, axis=1)
        self._rows, self._slopes = np.empty((term.count, term.size)), np.empty((0, 0, 0))
        requirements = self.kernel.expression.requirements
        self.demanding = requirements is not None
        self._requirements = None if requirements is None else requirements.residual()
        self._held = np.empty((term.count, 0 if requirements is None else len(requirements.rows)))

    def broken(self, values: Values) -> bool:
        """Test whether an assertion of the function fails at some factor, active or not.

        Raises:
            Exception: of the function, which is called if an assertion fails by the trace.
        """
        if self._requirements is None:
            return False
        self._evaluate(self._requirements.address, values, self._held, NO_SLOPES)
        if self._held.all():
            return False
        self.term.call_as_written(values)
        return True

    def difference(self, values: Values, direction: Array, move: Move, slopes: bool) -> str:
        """Reason for which the trace is not the function at these values; empty where it is.

        Args:
            values: the answer.
            direction: (width,) full tangent step of length one that ``move`` scales.
            move: along it.
            slopes: whether derivatives are compared as well.

        Raises:
            GraphError: the function changes its arguments.
        """
        batch, term, trace = self.term.batch, self.term, self.term.trace
        assert trace is not None
        try:
            points = term.points(values)
            theirs = batch.original(points)
            self._evaluate(self.kernel.address, values, self._rows, NO_SLOPES)
            if not (np.abs(self._rows - theirs) <= ALIKE * np.abs(theirs)).all():
                wrong = self._active(trace.differs(batch, points, theirs))
                if wrong.any():
                    beside = term.points(move(BESIDE))
                    wrong &= trace.differs(batch, beside, batch.original(beside))
                if wrong.any():
                    return f"at factor {int(np.argmax(wrong))} of an answer, what was traced is not what it computes"
            if not slopes or batch.single is not None:  # of one factor, the slopes are those of the source
                return ""
            try:
                wrong = self._wrong_slopes(batch, values, theirs, direction, move)
            except GraphError:
                raise
            except Exception:
                if not self.demanding:  # whose assertions may fail beside an answer
                    raise
                return ""
        except GraphError:
            raise
        except Exception as error:
            return f"at an answer it raises {type(error).__name__}: {error}"
        return (
            f"its derivatives differ from those of its trace at factor {int(np.argmax(wrong))}" if wrong.any() else ""
        )

    def _wrong_slopes(self, batch: Batch, values: Values, middle: Array, direction: Array, move: Move) -> BoolArray:
        """(n,) active factors whose slope along the direction differs for every length of the step."""
        term = self.term
        if not self._slopes.size:
            self._slopes = np.empty((term.count, term.size, self._columns.shape[1]))
        self._evaluate(self.kernel.address, values, self._rows, self._slopes)
        slope = np.einsum("nmd,nd->nm", self._slopes, direction[self._columns])
        # Arguments are rounded, and that is seen through the slopes.
        seen = np.maximum(np.abs(self._slopes).sum(axis=2), 1.0)
        reach = seen * float(np.abs(values.flat[self._places]).max(initial=0.0))
        reach = np.maximum(reach, float(np.abs(middle).max(initial=0.0)))
        wrong: BoolArray = np.ones(term.count, dtype=bool)

        def quotient(length: float) -> Array:
            return (batch.original(term.points(move(length))) - middle) / length

        for length in LENGTHS:
            ahead, behind = quotient(length), quotient(-length)
            doubt = RELATIVE * np.abs(slope) + ROUNDINGS * np.finfo(float).eps * reach / length
            for sure in (True, False):
                if not sure:
                    doubt += MARGIN * (
                        np.abs(ahead - quotient(2.0 * length)) + np.abs(behind - quotient(-2.0 * length))
                    )
                least, most = np.minimum(ahead, behind) - doubt, np.maximum(ahead, behind) + doubt
                wrong &= self._active(((slope < least) | (slope > most)).any(axis=1))
                if not wrong.any():
                    return wrong
        return wrong

    def _evaluate(self, address: int, values: Values, rows: Array, slopes: Array) -> None:
        """Run machine code of the trace for all factors."""
        evaluate_rows(address, values.flat[self._places], self.term.packed, self.kernel.table, rows, slopes)

    def _active(self, wrong: BoolArray) -> BoolArray:
        return wrong if self.term.active is None else wrong & self.term.active
