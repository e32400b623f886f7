"""Pictures of graphs, solutions and histories: what is drawn is what is there, and nothing global changes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

import unifg as fg
from own_manifolds import S2
from problems.graphs import drawn_to, graph_of, graph_with
from problems.known import line, short_drive
from scripts import run_script
from unifg.plots import factor_graph, shown
from unifg.plots.factor_graph import _apart
from unifg.solution.history import History
from unifg.solvers import SQP, GaussNewton, InteriorPoint
from unifg.typing import Array

SILENT = """
import sys
import numpy as np
import unifg as fg
from unifg.solvers import GaussNewton
graph = fg.Graph()
x = graph.variables("x", fg.SE2, 3)
graph.minimize(fg.prior, x, [0.0, 0.0, 0.0], sigma=0.1)
solution = GaussNewton().solve(graph, {x: np.ones((3, 3))})
print(graph)
assert "matplotlib" not in sys.modules
figures = graph.draw(), solution.plot(marginals=True), solution.history.plot()
import matplotlib
from matplotlib import rcParamsDefault
assert "matplotlib.pyplot" not in sys.modules
assert all(f.number == 0 if hasattr(f, "number") else True for f in figures)
figures[0].savefig(sys.argv[1])
"""


@pytest.mark.product(2, of="processes of their own")
def test_matplotlib_is_imported_when_something_is_drawn_and_pyplot_never(tmp_path: Path) -> None:
    target = tmp_path / "graph.png"
    run_script(SILENT, target)
    assert target.read_bytes()[:4] == b"\x89PNG"


def test_without_matplotlib_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    graph, _ = drawn_to([0.0, 0.0])
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(ImportError, match=r'pip install "unifg\[view\]"'):
        graph.draw()
    assert "prior" in str(graph)


def test_nothing_global_changes() -> None:
    before = dict(mpl.rcParams)
    graph, guess = short_drive()
    solution = SQP().solve(graph, guess)
    for figure in (graph.draw(), solution.plot(), solution.history.plot()):
        assert isinstance(figure, Figure)
        figure.canvas.draw()
    assert dict(mpl.rcParams) == before


# ---------------------------------------------------------------- the factor graph


def marks(figure: Figure, marker: str) -> list[tuple[float, float]]:
    """Places of circles or squares, those of the key left out."""
    found = []
    for drawn in figure.axes[0].get_lines():
        if drawn.get_marker() == marker:
            found += list(zip(*(np.atleast_1d(part).tolist() for part in drawn.get_data()), strict=True))
    return found


def edges(figure: Figure) -> Array:
    """(k, 2, 2) ends of all lines: first the factor, then the variable."""
    collections = [c for c in figure.axes[0].collections if isinstance(c, LineCollection)]
    return np.concatenate([np.array(c.get_segments()) for c in collections])


def near(place: Array, places: list[tuple[float, float]]) -> int:
    """Index of the place that equals this one."""
    away = np.abs(np.array(places) - place).max(axis=1)
    assert away.min() < 1e-9
    return int(away.argmin())


def test_every_factor_is_a_square_joined_to_its_variables() -> None:
    graph = fg.Graph()
    x, seen, b = (graph.variables(*of) for of in (("x", fg.SE2, 6), ("l", fg.Rn(2), 2), ("b", fg.Rn(1), 1)))
    i, j = [0, 1, 4, 5, 5], [0, 0, 1, 1, 0]
    graph.minimize(fg.between, x[:-1], x[1:], np.zeros(3), name="steps")
    graph.minimize(fg.between, x[[0, 1]], x[[5, 4]], np.zeros(3), robust=fg.Huber(1.0), name="closures")
    graph.minimize(lambda p, q, c: p[:, :2] - q + c, x[i], seen[j], b, active=np.arange(5) != 2, name="seen")
    graph.minimize_scalar(lambda c: c[:, 0] ** 2, b, name="small")
    graph.bound(seen, lower=-1.0, name="here")
    graph.fix(x[0], np.zeros(3))
    figure = graph.draw()
    circles, squares = marks(figure, "o"), marks(figure, "s")
    assert (len(circles), len(squares)) == (9, 5 + 2 + 5 + 1 + 2)
    assert len(set(circles)) == 9 and len({(round(a, 6), b) for a, b in squares}) == len(squares)
    joined: dict[int, list[int]] = {}
    for factor, variable in edges(figure):
        joined.setdefault(near(factor, squares), []).append(near(variable, circles))
    assert len(joined) == len(squares)
    degrees = sorted(len(ends) for ends in joined.values())
    assert degrees == [1] * 3 + [2] * 7 + [3] * 5
    heights = {y for _, y in squares}
    assert len(heights) == 5 and not heights & {y for _, y in circles}
    words = {text.get_text() for text in figure.axes[0].texts}
    assert {"steps", "closures", "seen", "small", "here", "x", "l", "b", "6 x SE2", "2 factors, >= -1"} <= words
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert {text.get_text() for text in legend.get_texts()} == {
        "variable", "fixed", "cost", "robust cost", "scalar cost", "bound", "not active",
    }  # fmt: skip
    by_row = {k: sorted({near(f, squares) for f, _ in edges(figure) if f[1] == y}) for k, y in enumerate(heights)}
    assert sorted(map(len, by_row.values())) == [1, 2, 2, 5, 5]


def test_members_stand_below_what_they_are_joined_to() -> None:
    graph, _ = short_drive()
    figure = graph.draw()
    x, u = graph.families["x"], graph.families["u"]
    circles = np.array(sorted(marks(figure, "o"), key=lambda at: (-at[1], at[0])))
    np.testing.assert_allclose(circles[: len(x), 0], np.arange(len(x)))
    np.testing.assert_allclose(circles[len(x) :, 0], np.arange(len(u)) + 0.5)


def test_lines_stand_where_few_edges_cross() -> None:
    """The second family below the first, later ones above unless they are joined to those below."""
    graph = fg.Graph()
    x, u, seen, mass = (graph.variables(*of) for of in (
        ("x", fg.SE2, 6), ("u", fg.Rn(2), 5), ("seen", fg.Rn(2), 3), ("mass", fg.Rn(1), 1),
    ))  # fmt: skip
    graph.minimize(lambda p, q: p[:, :2] - q, x[:3], seen, name="sightings")
    graph.minimize(lambda p, c, q, m: q[:, :2] - p[:, :2] - m * c, x[:-1], u, x[1:], mass, name="motion")
    for name, of in (("x own", x), ("u own", u), ("seen own", seen), ("mass own", mass)):
        graph.minimize(lambda p: p[:, :1], of, name=name)
    texts = [text for text in graph.draw().axes[0].texts if text.get_text() in graph._names | set(graph.families)]
    assert [text.get_text() for text in sorted(texts, key=lambda text: -text.get_position()[1])] == [
        "seen own", "seen", "sightings", "x own", "x", "motion", "u", "u own", "mass", "mass own",
    ]  # fmt: skip


@pytest.mark.parametrize("wanted", [[0.0, 0.0, 0.0], [2.0, 1.0, 1.0, 9.0], [5.0], [0.0, 0.4, 3.0, 3.3]])
def test_places_are_set_apart_about_their_middle(wanted: list[float]) -> None:
    found = _apart(np.array(wanted), 0.5)
    assert np.diff(np.sort(found)).min(initial=1.0) >= 0.5 - 1e-9
    assert np.mean(found) == pytest.approx(np.mean(wanted))
    assert (np.argsort(found, kind="stable") == np.argsort(wanted, kind="stable")).all()


def test_large_graphs_are_drawn_family_by_family() -> None:
    graph, x, seen = graph_of(("x", fg.SE2, 2000), ("landmarks of the building", fg.Rn(2), 40))
    graph.minimize(fg.between, x[:-1], x[1:], np.zeros(3), name="odometry")
    graph.fix(x[0], np.zeros(3))
    for k in range(60):
        graph.minimize(lambda p, q: p[:, :2] - q, x[k : k + 2], seen[k % 40], name=f"seen {k}")
    figure = graph.draw()
    assert len(marks(figure, "o")) == 2 and len(marks(figure, "s")) == 2 and len(edges(figure)) == 3
    words = {text.get_text() for text in figure.axes[0].texts}
    assert {"odometry  1999", "seen 0, ... (60 terms)  120", "2000", "SE2, 1 fixed", "landmark.."} <= words


@pytest.mark.parametrize("count", [factor_graph.NODES // 2, factor_graph.NODES // 2 + 1])
def test_the_limit_between_both_drawings(count: Any) -> None:
    graph, x = line(count)
    graph.minimize(fg.prior, x, np.zeros(2))
    assert len(marks(graph.draw(), "o")) == (count if 2 * count <= factor_graph.NODES else 1)


@pytest.mark.parametrize("name", ["$\\undefined$", "a$^$b$", "$", "$\\theta$"])
def test_names_may_hold_dollars(name: str) -> None:
    graph = fg.Graph()
    x = graph.variables(name, fg.Rn(1), 2)
    graph.minimize(fg.prior, x, [1.0], sigma=1.0, name=name)
    for figure in (graph.draw(), fg.solve(graph, {x: np.zeros((2, 1))}).plot()):
        figure.canvas.draw()


def test_odd_graphs_are_drawn() -> None:
    with pytest.raises(fg.ViewError, match="no variables"):
        fg.Graph().draw()
    graph = fg.Graph()
    graph.variables("alone", fg.Rn(1), 1)
    graph.draw().canvas.draw()
    x, y = graph.variables("x", S2, 3), graph.variables("y", fg.Product(a=fg.SO3, b=fg.Product(c=fg.Rn(2))), 70)
    for k in range(30):
        graph.minimize(lambda p: p[:, :1], y.a[k % 7], name=f"a rather long name of a term, number {k}")
    graph.minimize(lambda p, q: p[:, :1], x[1], x[1], name="twice")
    figure = graph.draw()
    figure.canvas.draw()
    assert any(text.get_text().startswith("30 factors, on y.a") for text in figure.axes[0].texts)


# ---------------------------------------------------------------- families of variables


def titled(figure: Figure) -> dict[str, Any]:
    """Axes by the first word of their titles."""
    return {ax.get_title(loc="left").partition(":")[0]: ax for ax in figure.axes if ax.get_title(loc="left")}


def labelled(ax: Any) -> dict[str, Array]:
    """Lines by their labels, (k, 2)."""
    return {drawn.get_label(): np.array(drawn.get_data()).T for drawn in ax.get_lines()}


def test_a_drive_is_a_path_and_controls_with_their_limits() -> None:
    graph, guess = short_drive()
    x, u = graph.families["x"], graph.families["u"]
    solution = SQP().solve(graph, guess)
    axes = titled(solution.plot())
    assert list(axes) == ["x", "u"]
    poses = solution[x]
    assert any(np.array_equal(np.array(drawn.get_data()).T, poses[:, :2]) for drawn in axes["x"].get_lines())
    quiver = next(c for c in axes["x"].collections if isinstance(c, Quiver))
    assert quiver.U is not None and quiver.V is not None
    np.testing.assert_allclose(np.arctan2(quiver.V, quiver.U), fg.wrap_angle(poses[:, 2]), atol=1e-12)
    lines = labelled(axes["u"])
    np.testing.assert_array_equal(lines["[0]"], np.stack([np.arange(len(u)), solution[u][:, 0]], axis=1))
    np.testing.assert_array_equal(lines["[1]"][:, 1], solution[u][:, 1])
    figure = solution.plot(u[3:7])
    np.testing.assert_array_equal(labelled(titled(figure)["u"])["[0]"][:, 0], [3, 4, 5, 6])
    assert "SQP: converged" in figure.get_suptitle()


@pytest.mark.parametrize("different", [False, True])
def test_limits_are_shaded_or_dashed(different: bool) -> None:
    graph, x = drawn_to([3.0, -3.0], 5)
    graph.bound(x, upper=[1.0, 2.0] if different else 1.0)
    graph.bound(x[1:3], lower=-2.0)
    graph.bound(x[2], lower=-1.0, upper=4.0)
    solution = InteriorPoint().solve(graph, {x: np.zeros((5, 2))})
    ax = titled(solution.plot())["x"]
    drawn = [np.array(d.get_ydata(), dtype=float) for d in ax.get_lines()]
    lower = [np.nan, -2.0, -1.0, np.nan, np.nan]
    assert any(np.array_equal(level, lower, equal_nan=True) for level in drawn)
    for upper in (1.0, 2.0) if different else (1.0,):
        assert any(np.array_equal(level, np.full(5, upper)) for level in drawn)
    assert sum(isinstance(c, PolyCollection) for c in ax.collections) == (1 if different else 2)
    assert ax.get_ylim()[1] >= 1.0


def test_ellipses_and_bands_are_two_standard_deviations() -> None:
    graph, x = graph_with(fg.SE2, 3)
    graph.minimize(fg.prior, x, [[0.0, 0.0, 0.5], [1.0, 0.0, 1.5], [2.0, 1.0, -2.0]], sigma=[0.3, 0.1, 0.05])
    solution = GaussNewton().solve(graph, {x: np.zeros((3, 3))})
    ax = titled(solution.plot(marginals=True))["x"]
    polygons = next(c for c in ax.collections if type(c) is PolyCollection).get_paths()
    for pose, path in zip(solution[x], polygons, strict=True):
        turn = np.array([[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]])
        away = (np.asarray(path.vertices)[:-1] - pose[:2]) @ turn
        np.testing.assert_allclose((away[:, 0] / 0.3) ** 2 + (away[:, 1] / 0.1) ** 2, 4.0, rtol=1e-6)
    graph, y = drawn_to([0.0, 0.0], 4, sigma=[0.5, 2.0])
    solution = GaussNewton().solve(graph, {y: np.ones((4, 2))})
    ax = titled(solution.plot(marginals=True))["x"]
    spans = [c.get_paths()[0].get_extents() for c in ax.collections]
    assert [(span.ymin, span.ymax) for span in spans] == [pytest.approx((-1.0, 1.0)), pytest.approx((-4.0, 4.0))]


def test_rotations_are_roll_pitch_and_yaw_and_products_are_taken_apart() -> None:
    state = fg.Product(pose=fg.SE3, arm=fg.Product(lift=fg.SO2, wrist=fg.SO3), speed=fg.Rn(1), eye=S2)
    graph, s = graph_with(state, 9, "s")
    rng = np.random.default_rng(3)
    truth = state.random(rng, (9,))
    turns = np.stack([np.linspace(0.0, 0.4, 9), np.linspace(0.1, 0.3, 9), np.linspace(0.0, 5.0, 9)], axis=1)
    truth[:, state.component("pose").storage] = fg.SE3.from_parts(rng.normal(size=(9, 3)), fg.SO3.from_rpy(*turns.T))
    truth[:, 7] = fg.wrap_angle(np.linspace(0.0, 9.0, 9))
    graph.minimize(lambda a: a, s.speed, sigma=0.1)
    graph.fix(s.pose, truth[:, state.component("pose").storage])
    graph.fix(s.arm, truth[:, state.component("arm").storage])
    graph.fix(s.eye, truth[:, state.component("eye").storage])
    solution = GaussNewton().solve(graph, {s: truth})
    figure = solution.plot(marginals=True)
    assert [ax.get_title(loc="left") for ax in figure.axes if ax.axison] == [
        "s.pose: 9 poses from above", "s.pose: height", "s.pose: rotation", "s.arm.lift: 9 x SO2",
        "s.arm.wrist: rotation", "s.speed: 9 x Rn(1)", "s.eye: 9 x S2",
    ]  # fmt: skip
    angles = labelled(next(ax for ax in figure.axes if ax.get_title(loc="left") == "s.pose: rotation"))
    for k, name in enumerate(("roll", "pitch", "yaw")):
        np.testing.assert_allclose(angles[name][:, 1], turns[:, k], atol=1e-9)
    lift = titled(figure)["s.arm.lift"].get_lines()[0].get_ydata()
    np.testing.assert_allclose(lift, np.linspace(0.0, 9.0, 9), atol=1e-12)  # not wrapped
    assert list(titled(solution.plot(s.arm[2:4]))) == ["s.arm.lift", "s.arm.wrist"]
    figure.canvas.draw()


def test_extended_poses_have_their_velocity_beside() -> None:
    graph, x = graph_with(fg.SE23, 5)
    truth = fg.SE23.random(np.random.default_rng(0), (5,))
    graph.minimize(fg.prior, x, truth, sigma=0.1)
    figure = GaussNewton().solve(graph, {x: truth}).plot(marginals=True)
    assert [ax.get_title(loc="left") for ax in figure.axes] == [
        "x: 5 poses from above", "x: height", "x: velocity", "x: rotation",
    ]  # fmt: skip
    np.testing.assert_allclose(labelled(figure.axes[2])["vy"][:, 1], truth[:, 4])
    yaw = np.unwrap(fg.SO3.to_rpy(truth[:, 6:])[2])
    np.testing.assert_allclose(labelled(figure.axes[3])["yaw"][:, 1], yaw, atol=1e-9)
    figure.canvas.draw()


def test_factors_between_poses_apart_are_lines() -> None:
    graph, x = graph_with(fg.SE2, 6)
    graph.fix(x[0], np.zeros(3))
    graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 1.0])
    graph.minimize(fg.between, x[[0, 1]], x[[5, 4]], np.zeros(3))
    solution = GaussNewton().solve(graph, {x: np.tile([0.5, 0.1, 0.2], (6, 1)) * np.arange(6)[:, None]})
    at = solution[x][:, :2]
    for chosen, pairs in ((x, [(0, 5), (1, 4)]), (x[1:], [(1, 4)]), (x[2:4], []), (x[[4, 1]], [(1, 4)])):
        ax = titled(solution.plot(chosen))["x"]
        drawn = [np.array(c.get_segments()) for c in ax.collections if isinstance(c, LineCollection)]
        assert len(drawn) == bool(pairs)
        if pairs:
            np.testing.assert_array_equal(drawn[0], [[at[i], at[j]] for i, j in pairs])


@pytest.mark.product(1, of="scenes and pictures")
def test_odd_selections_are_plotted_without_a_warning() -> None:
    graph, x = line(4)
    wide, poses = graph.variables("wide", fg.Rn(12), 2), graph.variables("poses", fg.SE2, 2)
    graph.minimize(fg.prior, x, [1.0, 2.0])
    graph.minimize(fg.prior, wide, np.arange(12.0))
    graph.minimize(fg.prior, poses, np.zeros(3))
    graph.bound(x[0], lower=-1.0, upper=5.0)
    solution = SQP().solve(graph, {x: np.zeros((4, 2)), wide: np.zeros((2, 12)), poses: np.zeros((2, 3))})
    for chosen in (x[0], x[[3, 0, 2]], x[[1, 1]], wide, wide[0]):
        for marginals in (False, True):
            solution.plot(chosen, marginals=marginals).canvas.draw()
    with pytest.raises(fg.GraphError, match="not part of this solution"):
        solution.plot(line(2)[1])
    for empty in (x[:0], poses[:0]):
        with pytest.raises(fg.ViewError, match="there are no variables to plot"):
            solution.plot(empty, marginals=empty.family is x)
    with pytest.raises(fg.ViewError, match="panels do not fit"):
        solution.plot(*[x] * (shown.PANELS + 1))


def test_without_covariances_the_picture_of_them_is_refused() -> None:
    graph, x = line(2)
    graph.minimize(fg.difference, x[0], x[1])
    solution = GaussNewton().solve(graph, {x: np.zeros((2, 2))})
    solution.plot(x)
    with pytest.raises(fg.GraphError, match="the covariance does not exist"):
        solution.plot(x, marginals=True)


# ---------------------------------------------------------------- the way of a solve


def test_the_history_is_plotted_row_by_row() -> None:
    graph, guess = short_drive()
    solution = SQP().solve(graph, guess)
    assert isinstance(solution.history, History) and solution.history is solution.history
    above, below = solution.history.plot().axes
    np.testing.assert_array_equal(above.get_lines()[0].get_ydata(), [row.cost for row in solution.history])
    errors = labelled(below)
    assert set(errors) == {"stationarity", "violation", "complementarity", "step"} and below.get_yscale() == "log"
    violation = np.array([row.violation for row in solution.history])
    np.testing.assert_array_equal(errors["violation"][:, 1], np.where(violation > 0.0, violation, np.nan))
    assert np.isnan(errors["step"][0, 1])


def test_histories_of_every_kind_are_plotted() -> None:
    graph, x = drawn_to([1.0, 1.0])
    free = GaussNewton().solve(graph, {x: np.zeros((1, 2))})
    assert "violation" not in labelled(free.history.plot().axes[1])
    done = GaussNewton().solve(graph, {x: np.ones((1, 2))})
    assert len(done.history) == 1
    done.history.plot().canvas.draw()
    graph.minimize_scalar(lambda p: -5.0 * np.sum(p, axis=1), x)
    SQP().solve(graph, {x: np.zeros((1, 2))}).history.plot().canvas.draw()
    with pytest.raises(fg.ViewError, match="no rows"):
        History().plot()


# ---------------------------------------------------------------- marginals of every member


@pytest.mark.parametrize("constrained", [False, True])
def test_marginals_are_the_blocks_of_the_joint_covariance(constrained: bool) -> None:
    """Of every member and component, fixed and held ones too, with constraints and without."""
    state = fg.Product(pose=fg.SE2, steer=fg.Rn(1))
    graph, s, u = graph_of(("s", state, 6), ("u", fg.Rn(2), 5))
    graph.fix(s[0].pose, np.zeros(3))
    graph.minimize(fg.between, s[:-1].pose, s[1:].pose, [1.0, 0.0, 0.2], sigma=[0.1, 0.2, 0.05])
    graph.minimize(lambda a, b, c: b - a - c[:, :1], s[:-1].steer, s[1:].steer, u, sigma=0.3)
    graph.minimize(fg.prior, u, [0.1, 0.0], sigma=[0.5, 2.0])
    graph.minimize(fg.prior, s.steer, [0.0], sigma=1.0)
    if constrained:
        graph.bound(s[3].steer, upper=-0.5)
        graph.constrain(lambda p: p[:, :1], s[5].pose, lower=4.0, upper=4.0)
    solution = SQP().solve(graph, {s: np.zeros((6, 4)), u: np.zeros((5, 2))}, check=True)
    for variable in (s, u, s.pose, s.steer, s.pose[1:4], s[[4, 2]].steer):
        each = solution.marginals(variable)
        assert each.shape[0] == len(variable)
        for k in range(len(variable)):
            np.testing.assert_allclose(each[k], solution.covariance(variable[k]), atol=1e-10)
    assert not solution.marginals(s.pose[0]).any()
    assert (solution.marginals(s[3].steer)[0, 0, 0] < 1e-9) == constrained
