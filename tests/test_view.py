"""Looking at solutions: what is in the file of a scene, and what is refused."""

from __future__ import annotations

import hashlib
import math
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from at_once import at_once
from problems.graphs import graph_of, graph_with
from scenes import check_offline, commands_of, data_of, tracks_of, without_viewer
from scripts import CHECKOUT, run_script
from unifg import view
from unifg.errors import GraphError, ViewError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.solvers import GaussNewton
from unifg.typing import Array
from unifg.view import Scene
from unifg.view.bodies import BODIES, Part
from unifg.view.shapes import box, column, copies, sphere

pytest.importorskip("meshcat")
POINT = fg.Rn(2)
STATE = fg.Product(pose=fg.SE2, speed=fg.Rn(1))


def offset_error(pose: Array, tree: Array, far: Array) -> Array:
    return tree - pose[:, : tree.shape[1]] - far


def chain(count: int = 5, group: Any = fg.SE2, offset: float = 0.0) -> tuple[fg.Solution, fg.Family, fg.Family]:
    """A way of poses a metre apart, and two trees seen from the first of them."""
    graph, x, trees = graph_of(("x", group, count), ("trees", fg.Rn(group.point_dim), 2))
    start = np.array(group.identity())
    start[0] += offset
    step = np.zeros(group.dim)
    step[0] = 1.0
    graph.minimize(fg.prior, x[0], start, sigma=0.1, name="origin")
    if count > 1:
        graph.minimize(fg.between, x[:-1], x[1:], group.exp(step), sigma=0.1, name="odometry")
    places = np.zeros((2, group.point_dim))
    places[:, :2] = [[offset + 1.0, 2.0], [offset + 3.0, -1.0]]
    far = places - start[: group.point_dim]
    graph.minimize(offset_error, x[0], trees, far, sigma=0.2, name="seen")
    guess = {x: np.tile(start, (count, 1)), trees: places}
    return GaussNewton(keep_values=True).solve(graph, guess), x, trees


@pytest.fixture(scope="module")
def solved() -> tuple[fg.Solution, fg.Family, fg.Family]:
    return chain()


def objects(page: str) -> dict[str, Any]:
    """Path below /meshcat/ to what was sent."""
    return {c["path"].removeprefix("/meshcat/"): c["object"] for c in commands_of(page) if c["type"] == "set_object"}


def vertices(sent: Any) -> Array:
    """(n, 3) of what was sent."""
    packed = sent["geometries"][0]["data"]["attributes"]["position"]["array"].data
    return np.frombuffer(packed, dtype=np.float32).reshape(-1, 3).astype(np.float64)


def legend(page: str) -> list[str]:
    return [key["text"] for key in data_of(page)["legend"]]


def test_a_solution_in_one_line(solved: tuple[fg.Solution, fg.Family, fg.Family], tmp_path: Path) -> None:
    solution, x, trees = solved
    path = Scene.of(solution, x, trees, sigmas=3, terms=["odometry", "seen"]).save(tmp_path / "scene.html")
    page = path.read_text(encoding="utf-8")
    check_offline(page)
    data, drawn = data_of(page), objects(page)
    assert legend(page) == ["x", "x: poses", "x: 3\u03c3", "trees", "trees: 3\u03c3", "odometry", "seen"]
    assert data["outcome"] == fg.Status.CONVERGED.value and data["good"] is True
    assert data["ticks"] == [0] and data["plots"] == []  # one picture: nothing to play
    middle = vertices(drawn["x"]).reshape(-1, 2, 3).mean(axis=1)
    np.testing.assert_allclose(middle[:, :2], solution[x][:, :2], atol=1e-6)
    np.testing.assert_allclose(vertices(drawn["trees"])[:, :2], solution[trees], atol=1e-6)
    lines = vertices(drawn["seen"]).reshape(-1, 2, 3)
    np.testing.assert_allclose(lines[:, 0, :2], np.tile(solution[x][0, :2], (2, 1)), atol=1e-6)
    np.testing.assert_allclose(lines[:, 1, :2], solution[trees], atol=1e-6)


def test_poses_are_shown_where_no_family_is_named(
    solved: tuple[fg.Solution, fg.Family, fg.Family],
) -> None:
    assert legend(Scene.of(solved[0]).html()) == ["x", "x: poses"]  # trees might be controls


@pytest.mark.parametrize("group", [fg.SE2, fg.SE3])
def test_ellipses_are_the_marginals_in_the_world(group: Any) -> None:
    """The farthest vertex from the middle is the longer half axis; the covariance is that of p + R d."""
    solution, x, _ = chain(3, group)
    page = Scene.of(solution, x[-1], sigmas=2.0).html()
    drawn = objects(page)
    outline = next(vertices(sent) for path, sent in drawn.items() if path.startswith("x: 2"))
    size = group.point_dim
    turn = group.matrix(solution[x[-1]])[0, :size, :size]
    covariance = turn @ solution.marginals(x[-1])[0, :size, :size] @ turn.T
    reach = np.linalg.norm(outline[:, :size] - solution[x[-1]][0, :size], axis=1).max()
    assert reach == pytest.approx(2.0 * math.sqrt(np.linalg.eigvalsh(covariance)[-1]), rel=0.02)


def test_covariances_of_places_that_a_function_gives_are_carried_through_it() -> None:
    graph, arm = graph_with(fg.SO2, 1, "arm")
    graph.minimize(fg.prior, arm, [0.5], sigma=0.1)
    solution = GaussNewton().solve(graph, {arm: [[0.4]]})
    scene = Scene.of(
        solution, arm, sigmas=1.0, position=lambda angle: 2.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    )
    outline = next(vertices(sent) for path, sent in objects(scene.html()).items() if path.endswith("edge"))
    along = np.array([-math.sin(0.5), math.cos(0.5)])
    offset = outline[:, :2] - 2.0 * np.array([math.cos(0.5), math.sin(0.5)])
    assert np.abs(offset @ along).max() == pytest.approx(0.2, rel=5e-3)  # 2 m times 0.1 rad
    assert np.abs(offset @ [math.cos(0.5), math.sin(0.5)]).max() < 1e-6


def test_iterates_are_on_the_slider_with_their_numbers(solved: tuple[fg.Solution, fg.Family, fg.Family]) -> None:
    solution, x, _ = solved
    page = Scene.of(solution, x, over="iterates").html()
    data, tracks = data_of(page), tracks_of(commands_of(page))
    rows = [row for row in solution.history if row.values is not None]
    assert data["counts"] == "iteration" and data["numbers"] == [row.number for row in rows]
    (cost, _) = data["plots"]
    assert cost["name"] == "cost" and cost["values"] == [row.cost for row in rows]
    assert data["play"] is False
    assert dict(tracks["x/1"][".visible"])[0] is False
    with pytest.raises(ViewError, match="keep_values=True"):
        graph, y = graph_with(POINT, 1, "y")
        graph.minimize(fg.prior, y, [0.0, 0.0], sigma=1.0)
        Scene.of(GaussNewton().solve(graph, {y: [[1.0, 1.0]]}), y, over="iterates")


@pytest.mark.parametrize("kind", sorted(BODIES))
def test_a_body_goes_along_the_members(kind: str) -> None:
    solution, x, _ = chain(4)
    page = Scene.of(solution, x, over="members", dt=0.25, body=kind, size=0.3).html()
    data, tracks = data_of(page), tracks_of(commands_of(page))
    places = np.array([value for _, value in tracks[f"x: {kind}"][".position"]])
    np.testing.assert_allclose(places[:, :2], solution[x][:, :2])
    assert data["counts"] == "time" and data["duration"] == 0.75
    assert f"Follow x: {kind}" in [view["text"] for view in data["views"]]


def test_solutions_one_after_the_other(solved: tuple[fg.Solution, fg.Family, fg.Family]) -> None:
    solution, x, trees = solved
    scene = Scene.of([solution, solution], x, trees, dt=0.1)
    scene.add(solution)
    page = scene.html()
    data = data_of(page)
    assert data["ticks"] == [0, 1, 2] and data["outcome"] == ""
    assert [row["name"] for row in data["readouts"]] == ["solver", "status", "iterations", "cost"]
    assert data["plots"][0]["values"] == [1e3 * solution.seconds] * 3
    assert "x" in objects(page)  # the same in all frames: sent once, and never hidden


def test_a_solution_of_another_graph_is_refused(solved: tuple[fg.Solution, fg.Family, fg.Family]) -> None:
    solution, x, _ = solved
    scene = Scene.of(solution, x)
    with pytest.raises(GraphError, match="family 'x' is not part of this solution"):
        scene.add(chain(3)[0])


def test_what_changes_is_shown_in_its_turn_and_what_stays_is_sent_once() -> None:
    scene = Scene("turns", dt=1.0)
    for k in range(4):
        with scene.frame() as frame:
            frame.way("plan", [[0.0, 0.0], [1.0, float(k >= 2)]])
            if k == 1:
                frame.points("hit", [[0.5, 0.5]])
            frame.trail("driven", [float(k), 0.0])
    page = scene.html()
    tracks = tracks_of(commands_of(page))

    def shown(path: str, tick: int) -> bool:
        keys = dict(tracks[path][".visible"])
        assert min(keys) == 0 and max(keys) == 3
        return bool(keys[max(time for time in keys if time <= tick)])

    assert [path for path in objects(page) if path.startswith("plan")] == ["plan/0", "plan/2"]
    assert [shown("plan/0", k) for k in range(4)] == [True, True, False, False]
    assert [shown("plan/2", k) for k in range(4)] == [False, False, True, True]
    assert [shown("hit/1", k) for k in range(4)] == [False, True, False, False]
    assert [shown("driven/1", k) for k in range(4)] == [False, False, True, True]


def test_a_body_is_seen_where_it_is_placed() -> None:
    scene = Scene(dt=1.0)
    scene.body("drone", "quadrotor", size=0.25)
    for k in range(4):
        frame = scene.frame()
        if k in (1, 2):
            frame.place("drone", [float(k), 0.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    tracks = tracks_of(commands_of(scene.html()))
    keys = dict(tracks["drone/parts"][".visible"])
    assert keys == {0: False, 1: True, 3: False}
    assert [value for _, value in tracks["drone"][".position"]] == [[1.0, 0.0, 1.0], [2.0, 0.0, 1.0]]
    with pytest.raises(ViewError, match="there is no body 'plane'"):
        scene.frame().place("plane", [0.0, 0.0, 0.0])


@pytest.mark.product(1, of="scenes and pictures")
def test_same_bytes_for_the_same_input(tmp_path: Path) -> None:
    code = (
        "import hashlib; from test_view import everything;"
        "print(hashlib.sha256(everything().html().encode()).hexdigest())"
    )
    printed = run_script(code, variables={"PYTHONPATH": f"{CHECKOUT / 'tests'}:{CHECKOUT}", "PYTHONHASHSEED": "7"})
    page = everything().save(tmp_path / "a.html").read_text(encoding="utf-8")
    assert printed.stdout.strip() == hashlib.sha256(page.encode()).hexdigest()


def everything() -> Scene:
    """One of each."""
    scene = Scene("everything", dt=0.5)
    occupied = np.zeros((8, 12), dtype=bool)
    occupied[0], occupied[:, 0] = True, True
    scene.map("map", OccupancyMap(occupied, ~occupied, 0.5, (0.0, 0.0, 0.1)))
    scene.way("line", [[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    scene.points("dots", [[1.0, 1.0, 1.0]])
    scene.lines("thin", [[[0.0, 0.0], [1.0, 1.0]]])
    scene.poses("axes", [[0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]])
    scene.poses("arrows", [[0.0, 0.0, 1.0]])
    scene.discs("discs", [[1.0, 1.0, 0.2], [2.0, 1.0, 0.3]], height=1.0)
    scene.boxes("boxes", [[3.0, 1.0, 0.5]], [1.0, 0.5, 1.0])
    scene.covariances("sure", [[1.0, 1.0, 1.0]], [np.diag([0.01, 0.02, 0.0])])
    scene.mesh("own", box([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]), lit=True)
    for kind in BODIES:
        scene.body(kind, kind, size=0.3)
    scene.body("mine", [Part("cube", box([0.0, 0.0, 0.0], [1.0, 1.0, 1.0]), "#ff8800")])
    for k in range(3):
        with scene.frame() as frame:
            for kind in [*BODIES, "mine"]:
                frame.place(kind, [float(k), 1.0, 0.5], scale=(1.0, 1.0, 1.0 + k))
            frame.readout("speed", f"{k} m/s", alarm=k == 2)
            frame.value("error", float(k))
    return scene


BAD = [[0.0, 1.0], [math.nan, 2.0]]
INDEFINITE = [[[1.0, 0.0], [0.0, 1.0]], [[1.0, 2.0], [2.0, 1.0]]]


def placed(scene: Scene, pose: list[float]) -> None:
    scene.body("robot", "disc")
    scene.frame().place("robot", pose)


@pytest.mark.parametrize(
    ("shape", "draw"),
    [
        (r"'walk': place 1 is \[nan, 2.0\]", lambda scene: scene.way("walk", BAD)),
        (r"'walk': place 1 is \[nan, 2.0\]", lambda scene: scene.points("walk", BAD)),
        ("'p': pose 0", lambda scene: scene.poses("p", [[0.0, math.inf, 0.0]])),
        ("'d': disc 0", lambda scene: scene.discs("d", [[0.0, math.nan, 0.0]])),
        ("'d': disc 0 has a radius of -2 m", lambda scene: scene.discs("d", [[0.0, 0.0, -2.0]])),
        ("'m': faces are .* of its 3 vertices", lambda scene: scene.mesh("m", (np.eye(3), np.array([[0, 1, 3]])))),
        ("'m': faces are .* of its 3 vertices", lambda scene: scene.mesh("m", (np.zeros((3, 3)), np.zeros((1, 3))))),
        ("'c': covariance 0", lambda scene: scene.covariances("c", [[0.0, 0.0]], [[[math.nan, 0.0], [0.0, 1.0]]])),
        ("'robot': pose 0", lambda scene: placed(scene, [0.0, 0.0, math.nan])),
        ("covariance 1 has a negative", lambda scene: scene.covariances("c", np.zeros((2, 2)), np.array(INDEFINITE))),
        ("quaternion of pose 0", lambda scene: scene.poses("p", [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])),
        ("quaternion of pose 0", lambda scene: scene.poses("p", [[0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0]])),
        ("places are", lambda scene: scene.way("a", np.zeros((2, 4)))),
        ("poses are", lambda scene: scene.poses("a", np.zeros((2, 4)))),
        ("lines are", lambda scene: scene.lines("a", np.zeros((2, 3, 2)))),
        ("discs are", lambda scene: scene.discs("a", np.zeros((2, 4)))),
        ("sizes are", lambda scene: scene.boxes("a", np.zeros((2, 3)), [1.0, 1.0])),
        ("need covariances", lambda scene: scene.covariances("a", np.zeros((2, 2)), np.zeros((2, 3, 3)))),
        ("no map but int", lambda scene: scene.map("a", 3)),
        ("no colour 'mauve'", lambda scene: scene.way("a", np.zeros((2, 2)), colour="mauve")),
        ("a name is empty", lambda scene: scene.way("", np.zeros((2, 2)))),
        ("no body 'boat'", lambda scene: scene.body("a", "boat")),
        ("must be positive", lambda scene: scene.body("a", "car", size=0.0)),
        ("either a place or a body", lambda scene: scene.label("a")),
        ("is no body", lambda scene: scene.label("a", follows="b")),
        ("is no body", lambda scene: scene.view("a", "b", (0.0, 0.0, 1.0), follows="b")),
        ("view 'v': a direction", lambda scene: scene.view("v", "V", (0.0, 0.0, 0.0))),
        ("view 'v': a direction", lambda scene: scene.view("v", "V", (0.0, 1.0))),
        ("view 'v': a direction", lambda scene: scene.view("v", "V", (0.0, 0.0, 1.0), math.nan)),
        ("limit of the plot 'p' is nan", lambda scene: scene.plot("p", limit=math.nan)),
        ("there is no frame 3: the scene has 1", lambda scene: scene.draw(frame=3)),
        ("Scene.of", lambda scene: scene.add(None)),
        ("nothing is drawn", lambda scene: scene.html()),
        ("must be positive", lambda scene: Scene(dt=0.0)),
        ("at least one frame", lambda scene: Scene(keep=0)),
    ],
)  # fmt: skip
def test_refusals_say_what_was_found(shape: str, draw: Any) -> None:
    with pytest.raises(ViewError, match=shape) as caught:
        draw(Scene())
    assert caught.value.index == (1 if "1 " in shape else 0 if " 0" in shape else None)


def test_rounding_is_not_refused() -> None:
    scene = Scene()
    scene.covariances("c", np.zeros((1, 2)), [[[1.0, 1.0], [1.0, 1.0 - 1e-12]]])
    scene.poses("p", [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]])


def test_what_has_no_place_is_refused_with_what_to_do() -> None:
    graph, q, s = graph_of(("q", fg.Rn(7), 2), ("s", STATE, 3))
    graph.minimize(fg.prior, q, np.zeros(7), sigma=1.0)
    graph.minimize(fg.prior, s, np.zeros(4), sigma=1.0)
    solution = GaussNewton().solve(graph, {q: np.zeros((2, 7)), s: np.zeros((3, 4))})
    refused: list[tuple[tuple[Any, ...], dict[str, Any], str]] = [
        ((q,), {}, r"'q' of Rn\(7\) cannot be drawn.*give position=lambda"),
        ((s,), {}, r"'s' of .*name a component \(s\.pose\), or give position="),
        ((), {}, r"no family of this solution has a place \('q' of Rn\(7\), 's' of"),
        ((q,), {"position": lambda v: np.full((len(v), 2), math.nan)}, "'q': place 0 is"),
        ((q,), {"position": lambda v: v[:, :5]}, r"returned \(2, 5\)"),
        ((s.pose,), {"terms": ["nothing"]}, "no term is called 'nothing'"),
        ((np.zeros(3),), {}, "found ndarray"),
        ((s.pose,), {"over": "time"}, "one of solutions, iterates, members"),
    ]
    for selection, options, message in refused:
        with pytest.raises((ViewError, GraphError), match=message):
            Scene.of(solution, *selection, **options)
    with pytest.raises(ViewError, match="no solution to look at"):
        Scene.of([], s.pose)
    assert legend(Scene.of(solution, s.pose).html()) == ["s.pose", "s.pose: poses"]
    assert legend(Scene.of(solution, q, position=lambda v: v[:, :3]).html()) == ["q"]


def test_empty_and_single_members_are_drawn() -> None:
    solution, x, trees = chain(1)
    page = Scene.of(solution, x, trees, sigmas=1.0).html()
    assert legend(page) == ["x", "x: 1\u03c3", "trees", "trees: 1\u03c3"]
    scene = Scene()
    scene.points("none", np.zeros((0, 2)))
    scene.discs("no discs", [])
    scene.covariances("unsure", np.zeros((0, 2)), np.zeros((0, 2, 2)))
    with pytest.raises(ViewError, match="nothing is drawn"):
        scene.html()
    scene.points("one", [[4.0, 5.0]])
    page = scene.html()
    assert "none" not in objects(page) and np.ptp(np.array(data_of(page)["corners"]), axis=0)[0] == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "path"),
    [
        *((word, word) for word in ("@@VIEWER@@", "@@COMMANDS@@", "@@DATA@@", "@@LIVE@@")),
        ("a/b", "a%2fb"), ("a", "a"), ("</script><img src=x>", "%3c%2fscript%3e%3cimg src=x%3e"), ("%2f", "%252f"),
        ("name \udc80", "name %dc80"),
    ],
)  # fmt: skip
def test_any_name_is_shown_as_it_is(name: str, path: str, tmp_path: Path) -> None:
    """Words of the template, markup, parts of paths, lone surrogates."""
    scene = Scene(name)
    scene.points(name, [[0.0, 1.0]])
    scene.label(name, [0.0, 0.0])
    page = scene.save(tmp_path / "scene.html").read_text(encoding="utf-8")
    around = without_viewer(page)  # which stands in it once
    assert len(around) < 100_000 and around.count("</script>") == 3
    assert "<img" not in around and "innerHTML" not in around
    assert data_of(page)["title"] == data_of(page)["labels"][0]["text"] == legend(page)[0] == name
    assert path in objects(page)


def test_far_from_the_origin_nothing_jitters() -> None:
    """Metres of UTM are large: in single precision 5e6 m is known to half a metre."""
    solution, x, _ = chain(5, offset=5.4e6)
    page = Scene.of(solution, x).html()
    middle = vertices(objects(page)["x"]).reshape(-1, 2, 3).mean(axis=1)
    np.testing.assert_allclose(np.diff(middle[:, 0]), 1.0, atol=1e-6)
    data = data_of(page)
    facts = dict(data["facts"])
    assert facts["shown around"] == "(5400002, 0, 0) m"
    assert np.abs(np.array(data["corners"])).max() < 10.0
    assert "shown around" not in dict(data_of(Scene.of(chain(5)[0]).html())["facts"])
    scene = Scene(dt=1.0, keep=3)
    scene.body("car", "car", size=2.0)
    scene.label("depot", [1e6, 1e6])
    for k in range(10):
        scene.frame().place("car", [1e6 + k, 1e6, 0.0])
    page = scene.html()
    places = np.array([value for _, value in tracks_of(commands_of(page))["car"][".position"]])
    assert np.abs(places).max() < 10.0 and np.abs(data_of(page)["labels"][0]["at"]).max() < 10.0
    assert np.abs(vertices(objects(page)["car/parts/body"])).max() < 10.0
    assert data_of(page)["ticks"] == [0, 1, 2]  # the latest three


def test_long_ways_over_many_ticks_stay_small() -> None:
    """2000 poses in each of 300 frames are 600 000; the page says how many of them it shows."""
    scene = Scene("long", dt=0.1)
    along = np.linspace(0.0, 50.0, 2000)
    for k in range(300):
        with scene.frame() as frame:
            frame.way("x", np.column_stack([along, np.sin(along + 0.01 * k)]))
            frame.poses("x: poses", np.column_stack([along, np.sin(along + 0.01 * k), np.cos(along)]))
    page = scene.html()
    assert len(page) < 12e6
    facts = dict(data_of(page)["facts"])
    assert facts["x, thinned"] == "333 of 2000" and facts["x: poses, thinned"] == "26 of 2000"


def test_scenes_in_threads_do_not_meet() -> None:
    assert at_once(lambda k: everything().html()) == [everything().html()] * 4


def test_a_distance_map_has_walls_where_the_distance_is_not_positive() -> None:
    occupied = np.zeros((10, 10), dtype=bool)
    occupied[:2] = True
    scene = Scene()
    scene.map("map", DistanceMap.from_occupancy(occupied, 0.5, (0.0, 0.0, 0.0)), height=2.0)
    walls = vertices(objects(scene.html())["map/walls"])
    assert walls[:, 1].max() == pytest.approx(1.0) and walls[:, 2].max() == pytest.approx(2.0)


def test_shapes_look_outwards() -> None:
    brick = box([1.0, 2.0, 3.0], [0.2, 0.4, 0.6])
    np.testing.assert_allclose(np.ptp(brick[0], axis=0), [0.2, 0.4, 0.6])
    for mesh, middle in (
        (sphere(), np.zeros(3)),
        (column(), np.array([0.0, 0.0, 0.5])),
        (brick, np.array([1.0, 2.0, 3.0])),
    ):
        corners = mesh[0][mesh[1]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        large = np.linalg.norm(normals, axis=1) > 1e-12
        assert (np.sum(normals * (corners.mean(axis=1) - middle), axis=1)[large] > 0.0).all()
    twice, faces = copies(
        sphere(), np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0]]), np.stack([np.eye(3), 2.0 * np.eye(3)])
    )
    assert twice[:, 0].max() == pytest.approx(7.0) and faces.max() == len(twice) - 1


@pytest.mark.skipif(shutil.which("node") is None, reason="node runs what the page says")
def test_numbers_beside_plots_keep_their_zeros() -> None:
    """110 cm are no 11 cm."""
    page = (Path(view.__file__).parent / "page.html").read_text(encoding="utf-8")
    (stated,) = re.findall(r"const short = .*?;\n", page, re.DOTALL)
    shown = {110.0: "110", 100.0: "100", 0.7: "0.7", 0.69512: "0.695", 0.0: "0", 1234.0: "1230", 2e4: "2.0e+4"}
    asked = f"{stated}console.log({list(shown)}.map(short).join(' '))"
    found = subprocess.run(["node", "-e", asked], capture_output=True, text=True, check=True)
    assert found.stdout.split() == list(shown.values())


def test_a_long_name_of_a_fact_leaves_its_text_room() -> None:
    page = (Path(view.__file__).parent / "page.html").read_text(encoding="utf-8")
    (columns,) = re.findall(r"\bdl \{[^}]*grid-template-columns: ([^;]*);", page)
    assert columns == "fit-content(60%) 1fr"  # "auto" takes all but a letter of the panel


@pytest.mark.parametrize("projection", [None, "3d"])
def test_a_frame_is_drawn_on_axes_as_a_browser_would_be_sent_it(projection: str | None) -> None:
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    from unifg.style.colours import css

    scene = Scene()
    scene.discs("pillar", [[3.0, 1.0, 0.5]], height=2.0, colour="moving")
    scene.body("robot", "disc", size=0.2)
    scene.lines("sight", [[[0.0, 0.0, 0.0], [3.0, 1.0, 1.0]]])
    scene.label("here", [0.0, 0.0])
    for k in range(3):
        with scene.frame() as frame:
            frame.place("robot", [float(k), 0.0, 0.0])
            frame.trail("driven", [float(k), 0.0])
            frame.points("hit", [[1.0, float(k)]])
    figure = Figure()
    ax: Any = figure.add_subplot(projection=projection)
    assert scene.draw(ax, 1) is ax
    assert ax.get_legend_handles_labels()[1] == ["pillar", "robot", "sight", "driven", "hit"]
    figure.canvas.draw()
    if projection:
        assert [type(c).__name__ for c in ax.collections] == ["Line3DCollection", "Poly3DCollection"]
        return
    assert [text.get_text() for text in ax.texts] == ["here"]
    shown = {to_hex(np.asarray(c.get_facecolor())[0]): c for c in ax.collections if isinstance(c, PolyCollection)}
    pillar, driven = shown[css("moving")], shown[css(scene.colour("driven"))]
    places = [np.concatenate([np.asarray(path.vertices) for path in c.get_paths()]) for c in (pillar, driven)]
    np.testing.assert_allclose([places[0].min(axis=0), places[0].max(axis=0)], [[2.5, 0.5], [3.5, 1.5]])
    assert places[1][:, 0].max() == pytest.approx(1.0)  # not further than this frame
    assert pillar.get_zorder() > driven.get_zorder()
