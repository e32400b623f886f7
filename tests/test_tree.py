"""Horizons that branch: answers of graphs stated by hand, weights by probability, warm starts along each tail."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_of
from test_horizon import LINE, Drive, line_window, step
from test_horizon_times import CART, TARGET, TICK, TIMES, Refusing, loop_of, motion
from unifg.codegen.compile_counter import counting
from unifg.errors import GraphError
from unifg.horizon import Context, ControlCost, Dynamics, LastPlanThenBrake, RecedingHorizon, Term, Tree, tree_of
from unifg.solvers import InteriorPoint
from unifg.typing import Array, ArrayLike

FORK = Tree.branched(2, (3, 4))
PRESENT = np.array([0.0, 0.4])


def gap(x: Array, ahead: Array) -> Array:
    """Room before something at a place (n, 1)."""
    return np.asarray(ahead - x[:, :1])


@dataclass
class Ends:
    """Cost of the ends of all tails, and a wall before each of them, where it is in that tail."""

    walls: ArrayLike = (np.inf, np.inf)

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        tree = tree_of(x)
        graph.minimize(fg.prior, x[tree.leaves], TARGET, sigma=[0.1, 0.2], name="end")
        graph.constrain(
            gap, x[1:], graph.data("walls", np.full((len(tree), 1), 1e3), each=True), lower=0.0, name="wall"
        )

    def data(self, now: Context[Any]) -> dict[str, ArrayLike]:
        tree, walls = now.tree, np.full(len(now.times), np.inf)
        assert tree is not None
        for path, wall in zip(tree.paths, np.asarray(self.walls), strict=True):
            walls[path] = np.minimum(walls[path], wall)
        return {"walls": np.minimum(walls, 1e3)[1:, None]}


def horizon(tree: Tree = FORK, ends: Ends | None = None, **options: Any) -> RecedingHorizon:
    terms: list[Term] = [Dynamics(motion), ends or Ends(), ControlCost(sigma=[1.0], change=[2.0])]
    return RecedingHorizon(CART, tree, terms, **{"solver": InteriorPoint(tolerance=1e-9), **options})


def by_hand(walls: ArrayLike, weights: ArrayLike) -> tuple[Array, Array]:
    """States and controls of both paths of ``FORK``, the shared part and each tail as families of their own."""
    graph, x, u = graph_of(("trunk", fg.Rn(2), 3), ("controls", fg.Rn(1), 2))
    graph.fix(x[0], PRESENT)
    parts: list[tuple[Any, Any, float, float]] = [(x, u, float(np.min(walls)), 1.0)]
    for k, (wall, weight) in enumerate(zip(np.asarray(walls), np.asarray(weights), strict=True)):
        steps = (3, 4)[k]
        parts.append(
            (graph.variables(f"x{k}", fg.Rn(2), steps), graph.variables(f"u{k}", fg.Rn(1), steps), wall, weight)
        )
    for part, (own, acting, wall, weight) in enumerate(parts):
        share = 1.0 / np.sqrt(weight)
        graph.minimize(fg.prior, acting, np.zeros(1), sigma=1.0 * share, name=f"effort {part}")
        graph.minimize(fg.difference, acting[:-1], acting[1:], sigma=2.0 * share, name=f"change {part}")
        if part:
            graph.constrain(motion, x[-1], acting[0], own[0], TICK, lower=0.0, upper=0.0, name=f"fork {part}")
            graph.minimize(fg.difference, u[-1], acting[0], sigma=2.0 * share, name=f"change at fork {part}")
            graph.minimize(fg.prior, own[-1], TARGET, sigma=np.array([0.1, 0.2]) * share, name=f"end {part}")
            graph.constrain(motion, own[:-1], acting[1:], own[1:], TICK, lower=0.0, upper=0.0, name=f"motion {part}")
        else:
            graph.constrain(motion, own[:-1], acting, own[1:], TICK, lower=0.0, upper=0.0, name=f"motion {part}")
        if np.isfinite(wall):
            rest = own if part else own[1:]
            graph.constrain(gap, rest, np.array([wall]), lower=0.0, name=f"wall {part}")
    graph.minimize(fg.prior, u[0], np.zeros(1), sigma=2.0, name="first change")
    solution = InteriorPoint(tolerance=1e-10).solve(
        graph, {f: np.zeros((len(f), f.manifold.dim)) for f in graph.families.values()}
    )
    assert solution.status is fg.Status.CONVERGED
    states = np.concatenate([solution[family] for family, *_ in parts])
    return states, np.concatenate([solution[acting] for _, acting, *_ in parts])


@pytest.mark.parametrize("walls", [(np.inf, np.inf), (np.inf, 0.2), (0.15, 0.22)])
@pytest.mark.parametrize("weights", [None, (0.7, 0.3), (0.1, 0.9)])
def test_a_tree_has_the_answer_of_the_graph_written_by_hand(walls: ArrayLike, weights: ArrayLike | None) -> None:
    options: dict[str, Any] = {} if weights is None else {"probabilities": lambda now: weights}
    loop = horizon(ends=Ends(walls), **options)
    loop.plan(PRESENT)
    assert loop.solution is not None and loop.solution.status is fg.Status.CONVERGED
    states, controls = by_hand(walls, (1.0, 1.0) if weights is None else weights)
    assert loop.solution[loop.x] == pytest.approx(states, abs=2e-6)
    assert loop.solution[loop.u] == pytest.approx(controls, abs=2e-5)


def test_a_chain_is_a_tree_without_branches_in_every_bit() -> None:
    runs = []
    for steps in (6, Tree(tuple(range(6)))):
        judge = Refusing(LastPlanThenBrake(CART, keep=2 * TICK), range(4, 8))
        loop = loop_of(TIMES, steps=steps, judge=judge, limits=(-1.0, 1.0))  # type: ignore[arg-type]
        state, plans = PRESENT, []
        for _ in range(12):
            plan = loop.plan(state, TARGET)
            plans.append((plan.controls, plan.states, plan.source, plan.iterations))
            state = CART.predicted(state, plan.control)
        runs.append(plans)
    for ours, others in zip(*runs, strict=True):
        assert np.array_equal(ours[0], others[0]) and np.array_equal(ours[1], others[1]) and ours[2:] == others[2:]


def test_probabilities_decide_and_the_plan_does_not_move_them() -> None:
    """Something that is 0.25 m ahead in the second tail only: the likelier it is, the slower is the shared control."""
    first = []
    asked: list[float] = []

    def believed(now: Context[float]) -> tuple[float, float]:
        asked.append(now.given)
        return 1.0 - now.given, now.given

    for probability in (0.001, 0.3, 0.999):
        loop = horizon(Tree.branched(2, (8, 8)), Ends((np.inf, 0.25)), probabilities=believed)
        plan = loop.plan(PRESENT, probability)
        assert asked.pop() == probability and not asked and loop.probabilities[-1] == pytest.approx(probability)
        assert plan.states[:, 0].max() <= 0.25 + 1e-6 and loop.solution is not None
        assert loop.solution[loop.x][loop.tree.paths[0]][:, 0].max() > 0.4
        first.append(float(plan.control[0]))
    assert first[0] > first[1] + 1e-3 > first[2] + 2e-3


def test_the_path_to_the_last_tail_is_applied_and_kept() -> None:
    judge = Refusing(LastPlanThenBrake(CART, keep=1.0), range(2, 4))
    loop = horizon(ends=Ends((np.inf, 0.2)), judge=judge)
    plan = loop.plan(PRESENT)
    assert loop.solution is not None
    assert np.array_equal(plan.states, loop.solution[loop.x][FORK.paths[1]])
    assert np.array_equal(plan.controls, loop.solution[loop.u][FORK.paths[1][1:] - 1])
    for k in (1, 2):
        kept = loop.plan(CART.predicted(PRESENT, plan.control))
        assert kept.source == "kept" and np.array_equal(kept.controls[: 6 - k], plan.controls[k:])
    assert loop.guess is None  # nothing was left to begin from


def test_a_refused_plan_leaves_a_guess_for_all_nodes() -> None:
    """States and controls of a path are told to the nodes of other tails by their times."""
    tree = Tree.branched(1, (2, 3))
    loop = horizon(tree)
    states, controls = np.arange(10.0).reshape(5, 2), np.arange(4.0)[:, None]
    guess = loop.guess_of(states, controls, loop.now(PRESENT))
    assert np.array_equal(guess.values[loop.x.family], states[[0, 1, 2, 3, 2, 3, 4]])
    assert np.array_equal(guess.values[loop.u], controls[[0, 1, 2, 1, 2, 3]])


@pytest.mark.parametrize("likely", [0, 1])
def test_a_warm_start_goes_on_along_each_tail(likely: int) -> None:
    """Nodes that are shared from now on are taken from the likelier tail."""
    weights = np.where(np.arange(2) == likely, 0.8, 0.2)
    loop = horizon(ends=Ends((np.inf, 0.2)), probabilities=lambda now: weights)
    loop.plan(PRESENT)
    assert loop.solution is not None and loop.guess is not None
    x, u, paths = loop.solution[loop.x], loop.solution[loop.u], FORK.paths
    nodes, controls = np.asarray(loop.guess.values[loop.x.family]), np.asarray(loop.guess.values[loop.u])
    for path in paths:
        own = path[3:]
        assert nodes[own[:-1]] == pytest.approx(x[own[1:]], abs=1e-12) and np.array_equal(nodes[own[-1]], x[own[-1]])
        assert controls[own[:-1] - 1] == pytest.approx(u[own[1:] - 1], abs=1e-12)
    shared = paths[likely][:3]
    assert nodes[shared] == pytest.approx(x[paths[likely][1:4]], abs=1e-12)
    assert controls[shared[1:] - 1] == pytest.approx(u[paths[likely][2:4] - 1], abs=1e-12)


def test_ticks_of_a_tree_compile_nothing_and_start_warm() -> None:
    totals = []
    for warm in (True, False):
        loop = horizon(ends=Ends((np.inf, 0.5)), probabilities=lambda now: (0.6, 0.4), solver=InteriorPoint())
        state, total = PRESENT, 0
        with counting() as compiled:
            for _ in range(8):
                plan = loop.plan(state)
                total += plan.iterations
                state = CART.predicted(state, plan.control)
                if not warm:
                    loop.forget()
        assert not compiled.compiled and not compiled.read and plan.source == "solved"
        totals.append(total)
    assert totals[0] < 0.8 * totals[1], totals


def test_node_times_may_differ_between_tails_and_change() -> None:
    tree = Tree.branched(1, (2, 2))
    times = np.array([0.0, 0.1, 0.2, 0.4, 0.3, 0.7])
    loop = horizon(tree, times=times)
    assert np.array_equal(
        loop.now(PRESENT).lengths, [0.1, 0.1, times[3] - times[2], times[4] - times[1], times[5] - times[4]]
    )
    loop.plan(PRESENT)
    loop.set_times([0.0, 0.1, 0.2, 0.3, 0.2, 0.3])
    assert np.array_equal(loop.kept.times, [0.0, 0.1, 0.2, 0.3])
    assert loop.plan(PRESENT).source == "solved"
    with pytest.raises(GraphError, match="growing numbers from 0 on"):
        loop.set_times([0.0, 0.1, 0.2, 0.3, 0.1, 0.3])
    with pytest.raises(GraphError, match="first step must be as long as a tick"):
        loop.set_times([0.0, 0.2, 0.3, 0.4, 0.5, 0.6])


def test_past_and_branching_future_are_one_graph() -> None:
    """A tail that is as good as certain is the plan without branches, and the estimate is that of the chain."""
    plans = []
    both: Any = lambda now: (0.5, 0.5)  # noqa: E731
    for tree, weights in ((6, None), (Tree.branched(2, (4, 4)), both)):
        terms: list[Term] = [Dynamics(step, 0.1), Far(), ControlCost(sigma=[1.0], change=[2.0])]
        loop = RecedingHorizon(
            LINE,
            tree,
            terms,
            solver=InteriorPoint(tolerance=1e-9),
            window=line_window(4),
            coupling="joint",
            probabilities=weights,
        )
        drive = Drive(6)
        for k in range(6):
            seen = {"gps": drive.positions[k] if drive.seen[k] else None}
            plan = loop.tick(measured=seen)
        plans.append((plan.controls, loop.estimate))
    assert plans[0][0] == pytest.approx(plans[1][0], abs=1e-5) and plans[0][1] == pytest.approx(plans[1][1], abs=1e-6)


class Far(Term):
    """Cost of every node but the present."""

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        graph.minimize(fg.prior, x[1:], TARGET, sigma=1.0, name="far")


@pytest.mark.parametrize(
    ("parents", "said"),
    [
        ((0, 2, 1), "node 2 of the tree must follow one of 0 ... 1, found 2"),
        ((0, 0), "2 nodes of the tree follow the present"),
        ((-1,), "node 1 of the tree must follow"),
    ],
)
def test_what_is_no_tree_is_refused(parents: tuple[int, ...], said: str) -> None:
    with pytest.raises(GraphError, match=said):
        Tree(parents)


def test_order_of_a_tree() -> None:
    assert FORK.parents == (0, 1, 2, 3, 4, 2, 6, 7, 8) and len(FORK) == 9
    assert [path.tolist() for path in FORK.paths] == [[0, 1, 2, 3, 4, 5], [0, 1, 2, 6, 7, 8, 9]]
    assert FORK.depths.tolist() == [0, 1, 2, 3, 4, 5, 3, 4, 5, 6]
    assert FORK.earlier.tolist() == [0, 1, 2, 3, 1, 5, 6, 7] and FORK.later.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert FORK.probabilities([3.0, 1.0]) == pytest.approx([1, 1, 1, 0.75, 0.75, 0.75, 0.25, 0.25, 0.25, 0.25])
    for wrong in ([1.0], [1.0, -1.0], [0.0, 0.0], [np.nan, 1.0]):
        with pytest.raises(GraphError, match="2 tails needs as many probabilities, finite ones that are not negative"):
            FORK.probabilities(wrong)
    for shared, tails in ((0, (2, 2)), (1, (2, 0))):
        with pytest.raises(GraphError, match="at least one step"):
            Tree.branched(shared, tails)


class Stating:
    """A term that states what it is given."""

    def __init__(self, state: Any) -> None:
        self.state = state

    def data(self, now: Context[Any]) -> dict[str, ArrayLike]:
        return {}


def scalar(x: Array) -> Array:
    return np.asarray(x[:, 0] ** 2)


@pytest.mark.parametrize(
    ("state", "said"),
    [
        (lambda g, x, u: g.minimize(fg.prior, x[:-1], TARGET), r"'x' is not selected by slice\(None, -1, None\)"),
        (lambda g, x, u: g.minimize(fg.prior, x[-1], TARGET), "'x' is not selected by -1"),
        (lambda g, x, u: g.minimize(fg.prior, x[np.int64(-1)], TARGET), "'x' is not selected by -1"),
        (lambda g, x, u: g.minimize(fg.difference, u[:-1], u[1:]), "'u' is not selected by"),
        (lambda g, x, u: g.minimize_scalar(scalar, x, name="odd"), "'odd' cannot be weighted by the probability"),
        (lambda g, x, u: g.minimize(fg.prior, x, TARGET, robust=fg.Huber(1.0), name="odd"), "'odd' cannot be"),
        (lambda g, x, u: g.minimize(fg.prior, x, TARGET, sigma=g.data("s", 1.0), name="odd"), "'odd' cannot be"),
        (lambda g, x, u: g.minimize(fg.prior, g.variables("w", fg.Rn(2), 3), TARGET, name="odd"), "'w' has 3 members"),
    ],
)  # fmt: skip
def test_terms_that_do_not_fit_a_tree_are_refused(state: Any, said: str) -> None:
    with pytest.raises(GraphError, match=said):
        RecedingHorizon(
            CART, FORK, [Dynamics(motion), Stating(state)], solver=InteriorPoint(), probabilities=lambda now: (0.5, 0.5)
        )


def test_components_of_branching_nodes_are_guarded_too() -> None:
    robot = replace(CART, state=fg.Product(p=fg.Rn(1), v=fg.Rn(1)))
    with pytest.raises(GraphError, match="this horizon branches"):
        RecedingHorizon(
            robot, FORK, [Stating(lambda g, x, u: g.minimize(fg.difference, x.p[:-1], x.p[1:]))], solver=InteriorPoint()
        )


@pytest.mark.parametrize("matrix", [False, True])
def test_each_kind_of_weight_follows_the_probability(matrix: bool) -> None:
    """Standard deviations of each factor, information matrices, and unknowns of a term's own, one for each control."""

    def state(graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        own = graph.variables("own", fg.Rn(1), 9)
        graph.minimize(
            fg.prior, own, np.ones(1), **({"information": 4.0 * np.eye(1)} if matrix else {"sigma": 0.5}), name="own"
        )
        graph.minimize(fg.prior, x, TARGET, sigma=np.linspace(1.0, 2.0, 10)[:, None] * np.ones(2), name="each")

    loop = horizon(probabilities=lambda now: (0.64, 0.36))
    terms: list[Term] = [Dynamics(motion), Stating(state)]
    loop = RecedingHorizon(CART, FORK, terms, solver=InteriorPoint(), probabilities=lambda now: (0.64, 0.36))
    found = {handle.name: np.asarray(value) for handle, value in loop.data(loop.now(PRESENT)).items()}
    share = FORK.probabilities((0.64, 0.36))
    own = found["own: by probability"]
    assert own.ravel() == pytest.approx(4.0 * share[1:] if matrix else 0.5 / np.sqrt(share[1:]))
    assert found["each: by probability"][:, 0] == pytest.approx(np.linspace(1.0, 2.0, 10) / np.sqrt(share))
