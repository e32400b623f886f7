"""jaxls on a pose graph, and its augmented Lagrangian on the unicycle's problem, beside unifg in one process each.

jaxls takes CHOLMOD from scikit-sparse, which has no wheels: cvxopt's stands in for it, and forms A A' as CHOLMOD would.
The constraints of jaxls run with 32 bits only, the pose graph runs with 64.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import scipy.sparse as sp

from benchmarks.timing import all_cores
from problems.control import Problem
from unifg.pose_graphs import PoseGraph
from unifg.typing import Array

Solve = Callable[[], tuple[Any, int]]
"""A solve to the end: values of jaxls, and iterations."""


def load(bits: int) -> Any:
    """Package jaxls for floats of so many bits, on one thread of the processor."""
    single = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ |= {"JAX_ENABLE_X64": str(int(bits == 64)), "JAX_PLATFORMS": "cpu", "XLA_FLAGS": single}
    package, shim = ModuleType("sksparse"), ModuleType("sksparse.cholmod")
    shim.__dict__["analyze_AAt"] = lambda _: Cholmod()
    package.__dict__["cholmod"] = shim
    sys.modules |= {"sksparse": package, "sksparse.cholmod": shim}
    with all_cores():  # with threads for one core a callback waits for itself
        import jax
        import jaxls
        from loguru import logger

        jax.devices()
    logger.remove()
    return jaxls


class Cholmod:
    """Part of a factor of scikit-sparse that jaxls uses: A A' + beta I, analysed once."""

    def __init__(self) -> None:
        """Analyse nothing yet."""
        self._factor: Any = None

    def cholesky_AAt(self, a: Any, beta: float = 0.0) -> Cholmod:
        """Factorise."""
        from cvxopt import cholmod, spmatrix

        cholmod.options["supernodal"] = 2
        lower = sp.tril(a @ a.T + float(beta) * sp.identity(a.shape[0]), format="coo")
        matrix = spmatrix(lower.data, lower.row, lower.col, lower.shape)
        if self._factor is None:
            self._factor = cholmod.symbolic(matrix)
        cholmod.numeric(matrix, self._factor)
        return self

    def solve_A(self, b: Any) -> Array:
        """Solve."""
        from cvxopt import cholmod, matrix

        x = matrix(np.asarray(b, dtype=np.float64))
        cholmod.solve(self._factor, x)
        return np.array(x, dtype=np.asarray(b).dtype).ravel()

    __call__ = solve_A


class Jaxls:
    """A solver.

    Attributes:
        answer: of the last solve.
        status, iterations: of the last solve; jaxls says nothing about how it ended.
    """

    def __init__(self, solve: Solve, read: Callable[[Any], Any]) -> None:
        """Take a solve, and what reads its values."""
        self._solve, self._read = solve, read
        self.status, self.iterations = "", 0
        self.answer: Any = None

    def __call__(self) -> float:
        """Solve; seconds."""
        begin = time.process_time()
        values, self.iterations = self._solve()
        self.answer = self._read(values)  # waits for jax
        return time.process_time() - begin


def pose_graph(graph: PoseGraph) -> Jaxls:
    """Gauss-Newton with CHOLMOD on a planar pose graph, its first pose held by a prior."""
    jaxls = load(64)
    import jax.numpy as jnp
    import jaxlie

    edges, count = graph.edges, len(graph.poses)

    def poses(stored: Array) -> Any:
        return jaxlie.SE2.from_xy_theta(*jnp.asarray(stored).T)

    @jaxls.Cost.factory  # type: ignore[untyped-decorator]
    def edge(values: Any, a: Any, b: Any, measured: Any, root: Any) -> Any:
        return root @ (measured.inverse() @ (values[a].inverse() @ values[b])).log()

    @jaxls.Cost.factory  # type: ignore[untyped-decorator]
    def anchor(values: Any, a: Any, held: Any) -> Any:
        return 1e3 * (held.inverse() @ values[a]).log()

    variables, roots = jaxls.SE2Var(jnp.arange(count)), np.linalg.cholesky(edges.information).transpose(0, 2, 1)
    ends = (jaxls.SE2Var(jnp.asarray(end)) for end in (edges.first, edges.second))
    first = jaxls.SE2Var(jnp.arange(1))
    costs = [edge(*ends, poses(edges.measured), jnp.asarray(roots)), anchor(first, poses(graph.poses[:1]))]
    problem = jaxls.LeastSquaresProblem(costs, [variables]).analyze(use_onp=True)
    initial = jaxls.VarValues.make([variables.with_value(poses(graph.poses))])

    def solve() -> tuple[Any, int]:
        values, summary = problem.solve(
            initial, linear_solver="cholmod", trust_region=None, verbose=False, return_summary=True
        )
        return values, int(summary.iterations)

    def read(values: Any) -> list[Array]:
        found = values.get_stacked_value(jaxls.SE2Var)
        return [np.column_stack([found.translation(), found.rotation().as_radians()])]

    return Jaxls(solve, read)


def augmented(problem: Problem) -> Jaxls:
    """Augmented Lagrangian on a unicycle's problem, with dense Cholesky: CHOLMOD fails for 32 bits."""
    jaxls = load(32)
    import jax
    import jax.numpy as jnp

    class State(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):  # type: ignore[misc, call-arg, name-defined]
        pass

    class Control(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(2)):  # type: ignore[misc, call-arg, name-defined]
        pass

    @jaxls.Cost.factory  # type: ignore[untyped-decorator]
    def track(values: Any, a: Any, wanted: Any, weight: Any) -> Any:
        return weight * (values[a] - wanted)

    @jaxls.Cost.factory(kind="constraint_eq_zero")  # type: ignore[untyped-decorator]
    def dynamics(values: Any, a: Any, b: Any, c: Any) -> Any:
        x, u, after, dt = values[a], values[b], values[c], problem.dt
        middle = x[2] + 0.5 * dt * u[1]
        return after - x - dt * jnp.stack([u[0] * jnp.cos(middle), u[0] * jnp.sin(middle), u[1]])

    @jaxls.Cost.factory(kind="constraint_eq_zero")  # type: ignore[untyped-decorator]
    def start(values: Any, a: Any) -> Any:
        return values[a] - jnp.asarray(problem.start)

    @jaxls.Cost.factory(kind="constraint_leq_zero")  # type: ignore[untyped-decorator]
    def limits(values: Any, a: Any) -> Any:
        return jnp.concatenate([values[a] - problem.upper, problem.lower - values[a]])

    @jaxls.Cost.factory(kind="constraint_geq_zero")  # type: ignore[untyped-decorator]
    def clear(values: Any, a: Any) -> Any:
        return jnp.linalg.norm(values[a][None, :2] - problem.discs[:, :2], axis=1) - problem.discs[:, 2]

    n, (wanted, cruise) = problem.horizon, problem.reference()
    x, u = State(jnp.arange(n + 1)), Control(jnp.arange(n))
    now, after = State(jnp.arange(n)), State(jnp.arange(1, n + 1))
    weights = np.vstack([np.tile(problem.stage, (n, 1)), problem.terminal]), np.tile(problem.effort, (n, 1))
    roots = [jnp.sqrt(jnp.asarray(weight) / 2) for weight in weights]  # jaxls has no 1/2
    costs = [track(x, jnp.asarray(wanted), roots[0]), track(u, jnp.asarray(cruise), roots[1])]
    costs += [dynamics(now, u, after), start(State(jnp.arange(1))), limits(u)]
    costs += [clear(after)] if problem.blocked else []
    built = jaxls.LeastSquaresProblem(costs, [x, u]).analyze(use_onp=True)
    states, controls = (jnp.asarray(part, dtype=jnp.float32) for part in problem.guess())
    limit = jaxls.TerminationConfig(max_iterations=1000)
    initial = jaxls.VarValues.make([x.with_value(states), u.with_value(controls)])

    def solve() -> tuple[Any, int]:
        values, summary = built.solve(
            initial, linear_solver="dense_cholesky", termination=limit, verbose=False, return_summary=True
        )
        return values, int(summary.iterations)

    def read(values: Any) -> list[Array]:
        return [np.asarray(values.get_stacked_value(kind), dtype=np.float64) for kind in (State, Control)]

    return Jaxls(solve, read)
