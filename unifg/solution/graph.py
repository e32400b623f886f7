"""The graph a user holds: what is stated, and what it can be asked before a solve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from unifg.elimination.tree import EliminationTree
from unifg.modeling.model import Model
from unifg.modeling.variables import Data
from unifg.problem.compiled_problem import CompiledProblem, compile_graph
from unifg.solution.check import Report, check_graph
from unifg.solution.solution import AnyGuess, values_of
from unifg.typing import Figure, Numbers


class Graph(Model):
    """Variables on Lie groups, costs and constraints over them.

    The objective is ``sum 1/2 |r|^2`` over the costs plus the scalar costs; constraints read
    ``lower <= g(x) <= upper``. A graph holds no values: a solve takes a guess and returns a solution,
    and changes neither the graph nor the guess. ``print(graph)`` lists what it holds.

    Attributes:
        families: variable families by name.
        terms: costs and constraints in the order they were stated.
        fixes: fixed variables.
    """

    def check(self, guess: AnyGuess, data: Mapping[Data, Numbers] | None = None) -> Report:
        """Look for mistakes at ``guess``, or at a solution: see :mod:`unifg.solution.check`."""
        return check_graph(self, values_of(guess), data)

    def routes(self) -> dict[str, str]:
        """For each term by name, how it is evaluated and differentiated; nothing before the graph is compiled."""
        return (
            {term.name: term.route for term in self.compiled.terms}
            if isinstance(self.compiled, CompiledProblem)
            else {}
        )

    def draw(self) -> Figure:
        """Draw the factor graph: variables as circles, factors as squares, of large graphs families and terms.

        The figure is a matplotlib ``Figure`` that belongs to nobody else; ``.savefig("graph.png")`` writes it.

        Raises:
            ViewError: there are no variables.
        """
        from unifg.plots.factor_graph import draw_graph  # only who draws loads it

        return draw_graph(list(self.families.values()), self.terms, self.fixes)

    def compile(self) -> CompiledProblem:
        """Offsets, ordering and sparsity; computed once and kept until the graph changes.

        Raises:
            GraphError: when the graph has no variable, or a variable no term touches.
        """
        return compile_graph(self)

    def elimination_tree(self) -> EliminationTree:
        """Bayes tree of the elimination of this graph, to print and to draw."""
        program = self.compile()
        columns, blocks = program.columns, program.blocks
        first = [int(columns.free[k]) for k in np.unique(blocks, return_index=True)[1]]
        names = tuple("{}[{}]".format(*columns.name(column)) for column in first)
        return replace(program.systems.normal().tree, names=names)
