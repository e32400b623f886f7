"""jaxls on a pose graph, and its augmented Lagrangian on the unicycle's problem, beside unifg in one process each.

jaxls takes CHOLMOD from scikit-sparse, which has no wheels: cvxopt's stands in for it, and forms A A' as CHOLMOD would.
The constraints of jaxls run with 32 bits only, the pose graph runs with 64.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import cvxopt
import cvxopt.cholmod
import numpy as np
import scipy.sparse as sp

from benchmarks.timing import all_cores
from problems.control import Problem
from unifg.pose_graphs import PoseGraph
from unifg.typing import Array


def load(bits: int) -> Any:
    """Package jaxls for floats of so many bits, on one thread of the processor."""
    single = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
    os.environ |= {"JAX_ENABLE_X64": str(int(bits == 64)), "JAX_PLATFORMS": "cpu", "XLA_FLAGS": single}
    shim: Any = SimpleNamespace(analyze_AAt=lambda _: Cholmod())
    package: Any = SimpleNamespace(cholmod=shim)
    cvxopt.cholmod.options["supernodal"] = 2
    sys.modules |= {"sksparse": package, "sksparse.cholmod": shim}
    with all_cores():  # with threads for one core a callback waits for itself
        import jax
        import jaxls
        from loguru import logger

        jax.devices()
    logger.remove()
    return jaxls


class Cholmod:
    """Factor of A A' + beta I, the part of scikit-sparse that jaxls uses; analysed once."""

    def __init__(self, factor: Any = None) -> None:
        """Keep an analysed factor."""
        self._factor = factor

    def cholesky_AAt(self, a: Any, beta: float) -> Cholmod:
        """Factorise."""
        lower = sp.tril(a @ a.T + float(beta) * sp.identity(a.shape[0]), format="coo")
        matrix = cvxopt.spmatrix(lower.data, lower.row, lower.col, lower.shape)
        self._factor = self._factor or cvxopt.cholmod.symbolic(matrix)
        cvxopt.cholmod.numeric(matrix, self._factor)
        return self

    def solve_A(self, b: Any) -> Array:
        """Solve."""
        x = cvxopt.matrix(np.asarray(b, dtype=np.float64))
        cvxopt.cholmod.solve(self._factor, x)
        return np.array(x).ravel()


class Jaxls:
    """A solver.

    Attributes:
        answer: of the last solve.
        status, iterations: of the last solve; jaxls says nothing about how it ended.
    """

    def __init__(self, problem: Any, initial: Any, read: Callable[[Any], list[Array]], **options: Any) -> None:
        """Take an analysed problem, values to begin at, what makes arrays of an answer, and options of a solve."""
        self._problem, self._initial, self._read, self._options = problem, initial, read, options
        self.status, self.iterations = "", 0
        self.answer: Any = None

    def __call__(self) -> float:
        """Solve; seconds."""
        begin = time.process_time()
        values, summary = self._problem.solve(self._initial, verbose=False, return_summary=True, **self._options)
        self.answer, self.iterations = self._read(values), int(summary.iterations)  # waits for jax
        return time.process_time() - begin


def pose_graph(graph: PoseGraph) -> Jaxls:
    """Gauss-Newton with CHOLMOD on a planar pose graph, its first pose held by a prior."""
    jaxls = load(64)
    import jax.numpy as jnp
    import jaxlie

    edges, of = graph.edges, jaxls.SE2Var

    def poses(stored: Array) -> Any:
        return jaxlie.SE2.from_xy_theta(*jnp.asarray(stored).T)

    edge = jaxls.Cost.factory(lambda v, a, b, m, root: root @ (m.inverse() @ (v[a].inverse() @ v[b])).log())
    anchor = jaxls.Cost.factory(lambda v, a, held: 1e3 * (held.inverse() @ v[a]).log())
    variables = of(jnp.arange(len(graph.poses)))
    roots = jnp.asarray(np.linalg.cholesky(edges.information).transpose(0, 2, 1))
    ends = of(jnp.asarray(edges.first)), of(jnp.asarray(edges.second))
    costs = [edge(*ends, poses(edges.measured), roots), anchor(of(jnp.arange(1)), poses(graph.poses[:1]))]
    problem = jaxls.LeastSquaresProblem(costs, [variables]).analyze(use_onp=True)
    initial = jaxls.VarValues.make([variables.with_value(poses(graph.poses))])

    def read(values: Any) -> list[Array]:
        found = values.get_stacked_value(of)
        return [np.column_stack([found.translation(), found.rotation().as_radians()])]

    return Jaxls(problem, initial, read, linear_solver="cholmod", trust_region=None)


def augmented(problem: Problem) -> Jaxls:
    """Augmented Lagrangian on a unicycle's problem, with dense Cholesky: CHOLMOD fails for 32 bits."""
    jaxls = load(32)
    import jax
    import jax.numpy as jnp

    class State(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):  # type: ignore[misc, call-arg, name-defined]
        pass

    class Control(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(2)):  # type: ignore[misc, call-arg, name-defined]
        pass

    make, dt, n, discs = jaxls.Cost.factory, problem.dt, problem.horizon, problem.discs
    track = make(lambda v, a, wanted, weight: weight * (v[a] - wanted))
    start = make(kind="constraint_eq_zero")(lambda v, a: v[a] - problem.start)

    def gap(x: Any, u: Any, after: Any) -> Any:
        middle = x[2] + 0.5 * dt * u[1]
        return after - x - dt * jnp.stack([u[0] * jnp.cos(middle), u[0] * jnp.sin(middle), u[1]])

    def distances(x: Any) -> Any:
        return jnp.linalg.norm(x[None, :2] - discs[:, :2], axis=1) - discs[:, 2]

    dynamics = make(kind="constraint_eq_zero")(lambda v, a, b, c: gap(v[a], v[b], v[c]))
    limits = make(kind="constraint_leq_zero")(
        lambda v, a: jnp.concatenate([v[a] - problem.upper, problem.lower - v[a]])
    )
    clear = make(kind="constraint_geq_zero")(lambda v, a: distances(v[a]))
    x, u, now, after = (
        State(jnp.arange(n + 1)),
        *(kind(jnp.arange(n)) for kind in (Control, State)),
        jnp.arange(1, n + 1),
    )
    weights = np.vstack([np.tile(problem.stage, (n, 1)), problem.terminal]), np.tile(problem.effort, (n, 1))
    costs = [  # without 1/2
        track(family, jnp.asarray(wanted), jnp.sqrt(jnp.asarray(weight) / 2))
        for family, wanted, weight in zip((x, u), problem.reference(), weights, strict=True)
    ]
    costs += [dynamics(now, u, State(after)), start(State(jnp.arange(1))), limits(u)]
    costs += [clear(State(after))] if problem.blocked else []
    built = jaxls.LeastSquaresProblem(costs, [x, u]).analyze(use_onp=True)
    states, controls = (jnp.asarray(part, dtype=jnp.float32) for part in problem.guess())
    initial = jaxls.VarValues.make([x.with_value(states), u.with_value(controls)])

    def read(values: Any) -> list[Array]:
        return [np.asarray(values.get_stacked_value(kind), dtype=np.float64) for kind in (State, Control)]

    limit = jaxls.TerminationConfig(max_iterations=1000)
    return Jaxls(built, initial, read, linear_solver="dense_cholesky", termination=limit)
