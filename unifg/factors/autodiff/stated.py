"""Kernels that say what they take and compute it in plain NumPy; the rest is derived when it is first needed."""

from __future__ import annotations

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

from unifg.factors.autodiff.expression import Expression, generating
from unifg.factors.autodiff.rows import traced
from unifg.factors.autodiff.symbols import TraceError
from unifg.factors.kernel import Argument, Kernel


@dataclass(frozen=True, eq=False)
class StatedKernel(Kernel):
    """A kernel whose ``function`` is batched NumPy: it is run once on symbols, in the shapes of ``arguments``.

    Where some of these are numbers of axes, it is run for every shape that is used.
    """

    function: Callable[..., Any]

    @property
    def derived(self) -> bool:
        """They are."""
        return True

    def of_shapes(self, shapes: Sequence[tuple[int, ...]]) -> Kernel:
        """The kernel for parameters of these shapes, for one factor."""
        rest = iter(shapes)
        return self._taking([next(rest) if isinstance(a, int | tuple) else a for a in self.arguments])

    def knowing(self, places: Container[int]) -> Kernel:
        """The kernel that takes the elements of manifolds at these places as parameters."""
        return self._taking(
            [
                (a.storage,) if k in places and not isinstance(a, int | tuple) else a
                for k, a in enumerate(self.arguments)
            ]
        )

    def _taking(self, arguments: Sequence[Argument]) -> Kernel:
        """The same function of other arguments, derived once."""
        stated = tuple(arguments)
        if stated == self.arguments:
            return self
        key = tuple([a if isinstance(a, tuple) else None for a in stated])  # manifolds take longer to hash
        with generating:
            known: dict[tuple[tuple[int, ...] | None, ...], Kernel] = self.__dict__.setdefault("_shaped", {})
            if key not in known:
                pairs = zip(self.arguments, key, strict=True)
                shapes = [a for own, a in pairs if a is not None and isinstance(own, int | tuple)]
                known[key] = replace(self, arguments=stated, rows=self.size(shapes))
            return known[key]

    @property
    def expression(self) -> Expression:
        """Expression; one for all threads, for it owns the machine code."""
        with generating:
            found = self.__dict__.get("_expression")
            if found is None:
                found = traced(self.function, self.arguments, name=self.name)
                if found.required:
                    raise TraceError(f"the kernel '{self.name}' asserts something, which nothing would test")
                self.__dict__["_expression"] = found
            return cast(Expression, found)

    @cached_property
    def address(self) -> int:
        """Of the machine code of residual and Jacobian."""
        return self.expression.residual().address

    @cached_property
    def second_address(self) -> int:
        """Of the machine code of second derivatives, 0 where all of them are zero."""
        return 0 if self.linear or all(self.expression.linear_rows) else self.expression.second().address

    def __getstate__(self) -> dict[str, Any]:
        """Pickle what is stated; another process derives it anew."""
        return {name: value for name, value in super().__getstate__().items() if name not in ("_expression", "_shaped")}
