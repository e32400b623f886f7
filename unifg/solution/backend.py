"""Interface of everything that solves graphs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import ClassVar, TypeAlias

from unifg.modeling.model import Model
from unifg.modeling.variables import Data
from unifg.solution.capabilities import Constraints
from unifg.solution.history import Iteration
from unifg.solution.solution import AnyGuess, Solution
from unifg.typing import Numbers

Callback: TypeAlias = Callable[[Iteration], bool | None]


class Backend(ABC):
    """Solver of a graph.

    Attributes:
        constraints: which it takes.
        scalar_costs: whether it takes costs that are no squares.
        soft: whether it takes the linear prices of soft constraints in any case.
        states_subproblems: whether rows of its history name the solver of a quadratic program, as their detail "qp".
        rehearses: whether :meth:`Solver.prepare` may take it through small problems of its own
            (:mod:`unifg.solution.warmup_run`).
    """

    constraints: ClassVar[Constraints] = "all"
    scalar_costs: ClassVar[bool] = True
    soft: ClassVar[bool] = False
    states_subproblems: ClassVar[bool] = False
    rehearses: ClassVar[bool] = False

    @property
    def name(self) -> str:
        """The backend's class name."""
        return type(self).__name__

    @abstractmethod
    def solve(
        self,
        graph: Model,
        guess: AnyGuess,
        *,
        data: Mapping[Data, Numbers] | None = None,
        check: bool = False,
        callback: Callback | None = None,
    ) -> Solution:
        """Solve once.

        Args:
            graph: the problem.
            guess: values per family, or a guess or solution that carries multipliers too.
            data: values of data for this solve; others keep their defaults.
            check: raise instead of returning a solution that did not converge.
            callback: called with every row of the history; returning True ends the solve.

        Raises:
            GraphError: when the graph, guess or data is malformed.
            BackendError: when this backend cannot take this class of problem.
            NotConverged: with ``check=True``.
        """
