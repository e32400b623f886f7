"""Windows over linear-Gaussian problems with hard dynamics lose nothing; joint priors on every group."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

import unifg as fg
from own_manifolds import Sphere
from problems.graphs import graph_of, graph_with
from unifg.errors import GraphError
from unifg.lie import Manifold
from unifg.pose_graphs import manhattan
from unifg.solution import marginal
from unifg.solvers import SQP, GaussNewton
from unifg.typing import Array

STATE, NOISE, BIAS, MARK = fg.Rn(2), fg.Rn(1), fg.Rn(1), fg.Rn(1)
TRANSITION, INPUT = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([0.0, 0.1])


def motion(x: Array, w: Array, b: Array, y: Array, u: Array) -> Array:
    """x+ = T x + G (u + w + b): two rows, one noise."""
    return np.asarray(y - x @ TRANSITION.T - INPUT * (u[:, None] + w + b))


def gap(x: Array, mark: Array, z: Array) -> Array:
    return mark - x[:, :1] - z[:, None]


class Drive:
    """Controls and measurements of a linear drive past some marks."""

    def __init__(self, steps: int, marks: int, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.controls = rng.normal(size=steps)
        self.gaps = rng.normal(size=(steps + 1, marks))
        self.seen = rng.random((steps + 1, marks)) < 0.6
        self.seen[0] = True

    def graph(self, first: int, last: int, arrival: tuple[Array, Array]) -> tuple[fg.Graph, list[fg.Family]]:
        """States ``first`` to ``last``, with a joint prior on the first one, the bias and the marks."""
        graph, n, marks = fg.Graph(), last - first, self.gaps.shape[1]
        x, w = graph.variables("x", STATE, n + 1), graph.variables("w", NOISE, n)
        b, m = graph.variables("b", BIAS, 1), graph.variables("m", MARK, marks)
        about: tuple[fg.Family | fg.Selection, ...] = (x[0], b, *(m[k] for k in range(marks)))
        joint = fg.joint_prior(*(part.manifold for part in about))
        graph.minimize(joint, *about, arrival[0], information=arrival[1], name="arrival")
        graph.minimize(fg.prior, w, [0.0], sigma=0.5, name="noise")
        graph.constrain(motion, x[:-1], w, b, x[1:], self.controls[first:last], lower=0, upper=0, name="motion")
        k, j = np.nonzero(self.seen[first : last + 1])
        graph.minimize(gap, x[k], m[j], self.gaps[first : last + 1][k, j], sigma=0.2, name="gaps")
        return graph, [x, w, b, m]


@pytest.mark.parametrize("seed", range(3))
def test_a_window_over_hard_dynamics_equals_the_batch(seed: int) -> None:
    """State, bias, marks and their covariance after 30 steps, from windows of four and all at once."""
    steps, length, marks = 30, 4, 3
    drive = Drive(steps, marks, seed)
    first = np.zeros(3 + marks), np.diag([4.0, 1.0, 2.0, *[0.01] * marks])
    arrival = first
    for k in range(steps - length + 1):
        graph, families = drive.graph(k, k + length, arrival)
        x, w, b, m = families
        start = {f: np.zeros((f.count, f.manifold.storage)) for f in families}
        window = SQP().solve(graph, start, check=True)
        if k < steps - length:
            mean, information = window.marginal_prior(
                ["arrival", "noise", "motion", "gaps"], (x[0], w[0]), (x[1], b, m)
            )
            assert mean.shape == (1, 3 + marks)
            arrival = mean[0], information
    graph, families = drive.graph(0, steps, first)
    start = {f: np.zeros((f.count, f.manifold.storage)) for f in families}
    whole = SQP().solve(graph, start, check=True)
    pairs: list[tuple[fg.Family | fg.Selection, ...]] = [(x[-1], families[0][-1]), (b, families[2]), (m, families[3])]
    for own, other in pairs:
        np.testing.assert_allclose(window[own], whole[other], atol=1e-8)
    np.testing.assert_allclose(
        window.covariance(x[-1], b, m), whole.covariance(families[0][-1], families[2], families[3]), atol=1e-7
    )


def test_a_prior_of_what_is_unknown_says_nothing() -> None:
    """A mark that was not seen and a fixed bias keep their values and have no information."""
    drive = Drive(3, 2, 5)
    drive.seen[:2, 1] = False
    graph, (x, w, b, m) = drive.graph(0, 3, (np.zeros(5), np.diag([4.0, 1.0, 2.0, 0.1, 0.0])))
    graph.fix(b, [0.3])
    start = {f: np.zeros((f.count, f.manifold.storage)) for f in (x, w, b, m)}
    solution = SQP().solve(graph, start, check=True)
    mean, information = solution.marginal_prior(["arrival", "noise", "motion", "gaps"], (x[0], w[0]), (x[1], b, m))
    assert np.abs(information[[2, 4]]).max() == 0.0
    assert np.abs(information[:, [2, 4]]).max() == 0.0
    assert mean[0, 2] == 0.3
    assert mean[0, 4] == solution[m][1, 0]
    assert np.linalg.eigvalsh(information[np.ix_([0, 1, 3], [0, 1, 3])]).min() > 0.1


def test_inequalities_and_ties_are_refused() -> None:
    drive = Drive(3, 2, 1)
    graph, (x, w, b, m) = drive.graph(0, 3, (np.zeros(5), np.eye(5)))
    graph.constrain(lambda q: q, w, lower=-9.0, upper=9.0, name="limit")
    start = {f: np.zeros((f.count, f.manifold.storage)) for f in (x, w, b, m)}
    solution = SQP().solve(graph, start)
    with pytest.raises(fg.GraphError, match=r"'limit' \(factor 0\) is an inequality"):
        solution.marginal_prior(["noise", "limit"], w[0], x[0])
    with pytest.raises(fg.GraphError, match="fix more than the removed variables"):
        solution.marginal_prior(["noise", "motion"], w[0], (x[0], x[1], b))  # two rows, one noise
    with pytest.raises(fg.GraphError, match=r"also depend on b\[0\]"):
        solution.marginal_prior(["noise", "motion"], (x[0], w[0]), x[1])
    with pytest.raises(fg.GraphError, match="do not determine it"):
        solution.marginal_prior(["motion"], (x[0], w[0]), (x[1], b))


def manifolds() -> tuple[Manifold, ...]:
    return fg.Product(p=fg.Rn(3), R=fg.SO3, v=fg.Rn(3)), fg.SE2, fg.Rn(2), fg.SE3, fg.SE23, fg.SO2


@pytest.mark.parametrize(
    ("leaving", "staying", "said"),
    [
        ([0, 1], [1, 2], r"x\[1\] is named twice: it leaves, once, or it stays"),
        ([0, 1, 0], [2], r"x\[0\] is named twice"),
        ([0, 1], [], "name at least one variable that leaves, and one that stays"),
        ([], [2], "name at least one variable that leaves, and one that stays"),
    ],
)
def test_a_variable_leaves_or_stays(leaving: list[int], staying: list[int], said: str) -> None:
    graph, x = graph_with(fg.Rn(1), 3)
    graph.minimize(fg.prior, x[0], [0.0], sigma=1.0, name="prior")
    graph.minimize(fg.between, x[:-1], x[1:], [1.0], sigma=1.0, name="between")
    solution = GaussNewton().solve(graph, {x: np.zeros((3, 1))})
    with pytest.raises(fg.GraphError, match=said):
        solution.marginal_prior(["prior", "between"], [x[k] for k in leaving], [x[k] for k in staying])


def test_a_joint_prior_is_priors_side_by_side(rng: np.random.Generator) -> None:
    kinds = manifolds()
    graph = fg.Graph()
    families = [graph.variables(f"v{k}", kind, 1) for k, kind in enumerate(kinds)]
    reference = [kind.random(rng) for kind in kinds]
    information = rng.normal(size=(30, 30))
    information = information @ information.T + np.eye(30)
    joint = fg.joint_prior(*kinds)
    graph.minimize(joint, *families, np.concatenate(reference), information=information)
    guess = {f: f.manifold.random(rng)[None] for f in families}
    assert not graph.check(guess).findings
    apart = np.concatenate([k.local(r, guess[f][0]) for k, r, f in zip(kinds, reference, families, strict=True)])
    values = joint(*guess.values(), np.concatenate(reference))
    np.testing.assert_allclose(values[0], apart, atol=1e-12)
    solution = GaussNewton().solve(graph, guess, check=True)
    for family, mean in zip(families, reference, strict=True):
        np.testing.assert_allclose(family.manifold.local(mean, solution[family][0]), 0.0, atol=1e-8)
    np.testing.assert_allclose(solution.covariance(*families), np.linalg.inv(information), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("kind", [Sphere, lambda: fg.Product(a=Sphere(), b=fg.Rn(1))], ids=["own", "product"])
def test_a_joint_prior_takes_manifolds_of_the_user(kind: Callable[[], Manifold], rng: np.random.Generator) -> None:
    one, other = kind(), fg.SE2
    graph, x, y = graph_of(("x", one, 1), ("y", other, 1))
    reference = np.concatenate([one.random(rng), other.random(rng)])
    information = np.eye(one.dim + 3) + 0.3
    graph.minimize(fg.joint_prior(one, other), x, y, reference, information=information)
    solution = GaussNewton().solve(graph, {x: one.random(rng)[None], y: other.random(rng)[None]}, check=True)
    found = np.concatenate([solution[x][0], solution[y][0]])
    np.testing.assert_allclose(found, reference, atol=1e-8)


def test_an_offset_moves_a_joint_prior_along_the_tangents(rng: np.random.Generator) -> None:
    """Farther than a turn, too: a quadratic has its lowest point where no point of a group is."""
    for kinds in (manifolds(), (Sphere(), fg.SE2)):
        graph = fg.Graph()
        families = [graph.variables(f"v{k}", kind, 1) for k, kind in enumerate(kinds)]
        size = sum(kind.dim for kind in kinds)
        reference, offset = np.concatenate([kind.random(rng) for kind in kinds]), 20.0 * rng.normal(size=size)
        graph.minimize(fg.joint_prior(*kinds, offset=True), *families, np.concatenate([reference, offset]), sigma=1.0)
        guess = {f: f.manifold.random(rng)[None] for f in families}
        assert not graph.check(guess).findings
        plain = fg.joint_prior(*kinds)(*guess.values(), reference)
        cost = GaussNewton(max_iterations=0).solve(graph, guess).cost
        np.testing.assert_allclose(cost, 0.5 * np.square(plain - offset).sum(), rtol=1e-12)


def test_a_marginal_prior_with_an_offset_is_the_same_model(rng: np.random.Generator) -> None:
    """Its lowest point is where the step leads, and its information is as symmetric as it is asked to be."""
    graph, x, b = graph_of(("x", fg.SE2, 2), ("b", fg.Rn(3), 1))
    graph.minimize(fg.prior, x[0], fg.SE2.random(rng), sigma=0.3, name="prior")
    graph.minimize(lambda p, q, c: fg.SE2.between(p, q) + 1e-4 * c, x[0], x[1], b[0], sigma=0.2, name="step")
    guess = {x: np.stack([fg.SE2.random(rng) for _ in range(2)]), b: rng.normal(size=(1, 3))}
    solution = GaussNewton(max_iterations=0).solve(graph, guess)
    lowest, information = solution.marginal_prior(["prior", "step"], x[0], (x[1], b))
    moved, same = solution.marginal_prior(["prior", "step"], x[0], (x[1], b), offset=True)
    here, step = moved[0, :6], moved[0, 6:]
    np.testing.assert_array_equal(here, np.concatenate([solution[x][1], solution[b][0]]))
    reached = np.concatenate([fg.SE2.retract(here[:3], step[:3]), here[3:] + step[3:]])
    np.testing.assert_allclose(reached, lowest[0], atol=1e-9 * np.abs(step).max())
    np.testing.assert_array_equal(same, information)
    np.testing.assert_array_equal(information, information.T)


@pytest.mark.parametrize("offset", [False, True])
def test_many_are_eliminated_by_the_tree_as_by_dense_matrices(monkeypatch: pytest.MonkeyPatch, offset: bool) -> None:
    """Poses of a city around eight that stay, of which one is fixed; a part that nothing determines is refused."""
    made = manhattan(200, seed=2).pose_graph
    graph, edges = fg.Graph(), made.edges
    x = graph.variables("x", fg.SE2, 200)
    graph.minimize(fg.between, x[edges.first], x[edges.second], edges.measured, information=edges.information)
    graph.fix(x[70], made.poses[70])
    solution = GaussNewton(max_iterations=1).solve(graph, {x: made.poses})
    kept = [0, 1, 30, 70, 71, 120, 150, 199]
    inner = x[np.setdiff1d(np.arange(200), kept)]
    found = []
    for many in (10**9, 0):
        monkeypatch.setattr(marginal, "MANY", many)
        found.append(solution.marginal_prior(["between"], inner, [x[k] for k in kept], offset=offset))
    (reference, information), (other, same) = found
    assert np.abs(other - reference).max() < 1e-9
    assert np.abs(same - information).max() < 1e-10 * np.abs(information).max()
    assert not same[9:12].any() and np.linalg.eigvalsh(same)[3] > 1.0  # that of the fixed one, and no other
    loose, y = graph_with(fg.SE2, 200, "y")
    loose.minimize(fg.between, y[:-2], y[1:-1], [1.0, 0.0, 0.0], sigma=0.1)
    loose.minimize(fg.prior, y[-1], np.zeros(3), sigma=0.1)
    unsolved = GaussNewton(max_iterations=0).solve(loose, {y: np.zeros((200, 3))})
    with pytest.raises(GraphError, match=r"y\[0\] cannot be eliminated: the terms between do not determine it"):
        unsolved.marginal_prior(["between"], y[:-1], y[-1])


def test_one_name_is_one_term() -> None:
    """Terms called by its letters do not stand for it."""
    graph, x = graph_with(fg.Rn(1), 2)
    graph.minimize(fg.prior, x[0], [0.0], sigma=0.1, name="p")
    graph.minimize(fg.difference, x[0], x[1], sigma=1.0, name="q")
    graph.minimize(lambda a, b: np.concatenate([a, a - 2.0 * b], axis=1), x[0], x[1], name="pq")
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 1))})
    one, listed = (solution.marginal_prior(name, x[0], x[1])[1] for name in ("pq", ["pq"]))
    np.testing.assert_array_equal(one, listed)
