"""Optimal control problems for solvers of casadi, in the order x_0, u_0, x_1, ... from which fatrop sees the stages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any, TypeAlias

import numpy as np

from benchmarks.compiled_peers import compiled as in_machine_code
from benchmarks.timing import clocked
from unifg.typing import Array

Rows: TypeAlias = Sequence[Any]
Stage: TypeAlias = Callable[[int, Any, Any], tuple[Any, Rows, Rows]]
"""Cost, rows that are zero and rows that are not negative, of index, state and control; no control at the end."""
Gap: TypeAlias = Callable[[Any, Any, Any], Any]
"""The next state less where the dynamics lead, of state, control and next state."""


def available() -> bool:
    """Test whether casadi is installed."""
    return find_spec("casadi") is not None


class Program:
    """A solver of casadi, with exact derivatives.

    Attributes:
        call: arguments of a solve, by casadi's names.
        answer, cost, iterations: of the last solve, the first with multipliers.
        status: of the last solve in words, "converged" where the solver says so.
        said: its own words.
    """

    def __init__(self, plugin: str = "ipopt", compiled: bool = False, **options: Any) -> None:
        """Choose a solver.

        Args:
            plugin: "ipopt" (with MUMPS) or "fatrop".
            compiled: whether functions run in machine code, not in casadi's virtual machine.
            options: of the plugin.
        """
        self._plugin, self._compiled, self._options = plugin, compiled, options
        self.answer: dict[str, Any] = {}

    def build(self, program: dict[str, Any], equality: Sequence[bool] = (), **call: Any) -> None:
        """Differentiate a program; ``equality`` tells fatrop which of its rows are zero."""
        import casadi as ca

        own = {"print_level": 0, **self._options}
        chosen: dict[str, Any] = {"print_time": False, self._plugin: own}
        if self._plugin == "fatrop":
            chosen |= {"structure_detection": "auto", "equality": equality}
        else:
            own["sb"] = "yes"
        self._solver: Any = ca.nlpsol("solver", self._plugin, program, chosen)
        if self._compiled:
            self._solver = in_machine_code(self._solver, self._plugin, chosen)
        self.call = call

    def __call__(self) -> float:
        """Solve; processor time of the call [s]: a shared machine makes clocks run late."""
        self.answer, seconds = clocked(self._solver, **self.call)
        found = self._solver.stats()
        self.said = str(found.get("return_status", "failed")).replace("_", " ").lower()
        self.status = "converged" if found["success"] else self.said
        self.cost, self.iterations = float(self.answer["f"]), int(found["iter_count"])
        return seconds

    def again(self) -> float:
        """The last solve once more, when everything it needs is in the caches [ms]."""
        return 1e3 * self()


class Staged(Program):
    """A solver of an optimal control problem."""

    def stages(
        self, sizes: tuple[int, int, int], stage: Stage, gap: Gap, parameters: Any, limits: tuple[Array, Array]
    ) -> None:
        """Build and differentiate the expressions.

        Args:
            sizes: numbers of a state and of a control, and horizon N.
            stage: what each node adds.
            gap: the dynamics.
            parameters: symbol of what changes between solves.
            limits: lower and upper ones, (N + 1, states + controls) or one row for all; the last controls are none.
        """
        import casadi as ca

        states, controls, n = self._sizes = sizes
        x = [ca.SX.sym("x", states) for _ in range(n + 1)]
        u = [ca.SX.sym("u", controls) for _ in range(n)]
        cost: Any = 0.0
        rows: list[Any] = []
        equality: list[bool] = []
        gaps: list[range] = []
        clearances: list[range] = []
        for k in range(n + 1):
            if k < n:
                gaps.append(range(len(equality), len(equality) + states))
                rows.append(gap(x[k], u[k], x[k + 1]))
                equality += [True] * states
            added, zero, positive = stage(k, x[k], u[k] if k < n else None)
            cost += added
            rows += [*zero, *positive]
            equality += [True] * sum(row.shape[0] for row in zero)
            if positive:
                clearances.append(range(len(equality), len(equality) + len(positive)))
                equality += [False] * len(positive)
        unknowns = ca.vertcat(*(part for pair in zip(x[:-1], u, strict=True) for part in pair), x[-1])
        program = {"x": unknowns, "p": parameters, "f": cost, "g": ca.vertcat(*rows)}
        lower, upper = (np.broadcast_to(limit, (n + 1, states + controls)).ravel()[:-controls] for limit in limits)
        bounds = {"lbx": lower, "ubx": upper, "lbg": 0.0, "ubg": np.where(equality, 0.0, np.inf)}
        self.build(program, equality, **bounds)
        self._staged = [np.array(found) for found in (gaps, clearances) if found]

    def begin(self, states: Array, controls: Array, parameters: Array, **duals: Any) -> None:
        """Take a guess and parameters."""
        unknowns = np.append(np.hstack([states[:-1], controls]).ravel(), states[-1])
        self.call |= {"x0": unknowns, "p": parameters, **duals}

    @property
    def trajectory(self) -> tuple[Array, Array]:
        """States (N + 1, d) and controls (N, m) of the last answer."""
        states, controls, n = self._sizes
        unknowns = np.append(np.asarray(self.answer["x"]).ravel(), np.zeros(controls)).reshape(n + 1, -1)
        return unknowns[:, :states], unknowns[:-1, states:]

    def shifted(self) -> tuple[Array, Array, dict[str, Array]]:
        """The last answer moved by one stage, the last one repeated: states, controls, and multipliers for `run`."""
        states, controls = (np.vstack([part[1:], part[-1:]]) for part in self.trajectory)
        old = np.asarray(self.answer["lam_g"]).ravel()
        of_rows = old.copy()
        for rows in self._staged:
            of_rows[rows[:-1]] = old[rows[1:]]
        of_bounds = np.asarray(self.answer["lam_x"]).ravel().copy()
        size, both = states.shape[1], states.shape[1] + controls.shape[1]
        of_bounds[: -size - both] = of_bounds[both:-size].copy()
        return states, controls, {"lam_g0": of_rows, "lam_x0": of_bounds}
