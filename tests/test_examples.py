"""Every script of examples/ runs, draws its picture, and is right about what it says."""

import re
import runpy
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from scripts import CHECKOUT
from unifg.models import rkmk

EXAMPLES = sorted((CHECKOUT / "examples").glob("*.py"))
PAGE = CHECKOUT / "docs" / "guide" / "examples.md"
PICTURES = CHECKOUT / "docs" / "images" / "examples"
LONGEST, LARGEST = 60, 60_000  # lines of a script, bytes of a picture
run_by_draw = pytest.mark.product(4, of="examples")


class Ran(dict[str, Any]):
    """The names of a script after it ran."""

    printed = ""
    folder = Path()


Run = Callable[[str], Ran]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """Run a script by its name as a user does, with a folder for its picture."""
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")

    def script(name: str) -> Ran:
        path = CHECKOUT / "examples" / f"{name}.py"
        monkeypatch.setattr(sys, "argv", [str(path), str(tmp_path / "new" / "folder")])
        ran = Ran(runpy.run_path(str(path), run_name="__main__"))
        plt.close("all")
        ran.printed, ran.folder = capsys.readouterr().out, tmp_path / "new" / "folder"
        picture = ran.folder / f"{name}.png"
        assert picture.stat().st_size < LARGEST
        return ran

    return script


def right(graph: fg.Graph, solution: fg.Solution) -> bool:
    """Test whether the KKT conditions hold, by derivatives taken apart from the library's."""
    return bool(solution.converged and judge(graph, solution).worst() < 2e-6)


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_is_short_tested_and_shown(path: Path) -> None:
    text, page = path.read_text(encoding="utf-8"), PAGE.read_text(encoding="utf-8")
    assert len(text.splitlines()) < LONGEST
    assert f"python examples/{path.name} [FOLDER]" in text
    known = set(re.findall(r"^\s*(?:from|import) ([\w.]+)", text, re.MULTILINE))
    inside = {path.stem for path in EXAMPLES} | {"benchmarks", "tests", "judge", "problems"}
    assert not {name for name in known if name.split(".")[0] in inside or name.startswith("unifg.scenarios")}
    assert f"](../../examples/{path.name})" in page
    assert f"](../images/examples/{path.stem}.png)" in page
    assert (PICTURES / f"{path.stem}.png").stat().st_size < LARGEST
    assert f"test_{path.stem}" in globals(), "a test has to say what is right about it"


def test_no_picture_is_left_of_an_example_that_is_gone() -> None:
    assert {picture.stem for picture in PICTURES.iterdir()} == {path.stem for path in EXAMPLES}


@run_by_draw
def test_swap_backends(run: Run) -> None:
    ran = run("swap_backends")
    assert set(ran["refusals"]) == {"LevenbergMarquardt"}
    assert len(ran["solutions"]) == 8
    for name, solution in ran["solutions"].items():
        assert right(ran["graph"], solution), name
        assert solution.cost == pytest.approx(24.8301, abs=2e-4), name
        assert re.search(rf"^{name} .*CONVERGED$", ran.printed, re.MULTILINE)


@run_by_draw
def test_unicycle_mpc_loop(run: Run) -> None:
    ran = run("unicycle_mpc_loop")
    assert len(ran["results"]) == 3
    for name, (off, gap) in ran["results"].items():
        assert 0.04 < gap < 0.06, name  # it asks for 0.05, and slips; the lane alone leads through the disc
        assert off < 0.06, name
    lane, disc = ran["lane"], ran["disc"]
    assert np.linalg.norm(lane[:, :2] - disc, axis=1).min() < ran["radius"] - 0.1


@run_by_draw
def test_barriers_in_a_smoother(run: Run) -> None:
    """The trajectory that grew is that of all factors at once, and the robot has kept off."""
    ran = run("barriers_in_a_smoother")
    smoother, x, graph, batch = ran["smoother"], ran["x"], ran["graph"], ran["batch"]
    assert right(graph, batch) and ran["apart"] < 3e-4 and len(smoother.estimate(x)) == 61
    near = [(np.linalg.norm(np.array(ran["driven"]) - c, axis=1) - r).min() for c, r in ran["discs"]]
    assert min(near) > 0.0 and max(near) < 0.15
    assert 11 <= ran["effort"].eliminated < 25  # of the past, what the new measurement has moved
    assert f"{ran['effort'].eliminated} of 61" in ran.printed


@run_by_draw
def test_covariance_aware_plan(run: Run) -> None:
    ran = run("covariance_aware_plan")
    x, P, light = ran["x"], ran["P"], []
    for k, plan in ran["plans"].items():
        assert plan.converged
        assert ran["kept"](plan[x][1:-1], plan[P][1:-1], k).min() > -1e-6
        np.testing.assert_allclose(plan[P][1:], ran["step"](plan[P][:-1], plan[x][1:]), atol=1e-6)
        light.append(plan[x][:, 1].max())
    assert abs(light[0]) < 1e-3 and 0.2 < light[1] < light[2]  # the more it wants to be sure, the farther it goes


@run_by_draw
def test_own_robot(run: Run) -> None:
    ran = run("own_robot")
    interior, augmented = ran["solutions"].values()
    graph, x, dt = ran["graph"], ran["x"], ran["dt"]
    assert right(graph, interior) and right(graph, augmented)
    assert interior.cost == pytest.approx(34.2240, abs=1e-3) and augmented.cost == pytest.approx(34.2644, abs=1e-3)
    for solution in (interior, augmented):
        assert ran["gaps"](solution[x[1:-1]]).min() > 0.05 - 1e-6
        assert np.abs(solution[x.steer]).max() < 0.6 + 1e-6
        assert solution[x.speed].min() < -1.0  # it reverses
        driven = rkmk.rollout(ran["STATE"], ran["car"], solution[x][0], solution[ran["u"]], h=dt)
        assert np.abs(ran["STATE"].local(driven[-1], solution[x][-1])).max() < 1e-5


@run_by_draw
def test_pose_graph_with_a_hard_closure(run: Run) -> None:
    ran = run("pose_graph_with_a_hard_closure")
    x, truth, half = ran["x"], ran["truth"], ran["N"] // 2
    open_loop, *closed = ran["solutions"].values()
    assert np.allclose(open_loop[x], ran["drifted"], atol=1e-9)  # nothing contradicts odometry
    for solution in closed:
        assert right(ran["graph"], solution)
        assert np.abs(fg.SE2.local(truth[-1], solution[x][-1])).max() < 1e-6
        assert np.abs(solution.covariance(x[-1])).max() < 1e-9
        assert np.trace(solution.covariance(x[half])) < 0.5 * np.trace(open_loop.covariance(x[half]))
        assert solution.cost == pytest.approx(0.255562, abs=1e-5)
        assert np.allclose(solution[x], closed[0][x], atol=1e-4)
    assert ran["slope"] == pytest.approx(-ran["pull"][0], rel=1e-2)


@run_by_draw
def test_inertial_odometry(run: Run) -> None:
    ran = run("inertial_odometry")
    assert ran["solution"].converged
    error, sigma = ran["error"], ran["sigma"]
    away = np.linalg.norm(error[:, :3], axis=1)
    assert re.fullmatch(
        rf"off by {away.max():.3f} m at most, by sigma {sigma[:, :3].max():.3f} m an axis\n", ran.printed
    )
    assert away.max() < 0.3 and np.median(away) < 0.1  # fixes are off by 0.17 m
    assert np.abs(error / sigma).max() < 3.5
    spread = np.sqrt(np.diag(ran["solution"].covariance(ran["b"][-1])))
    assert np.abs((ran["found"][-1] - ran["bias"]) / spread).max() < 3.5
    assert spread[:3].max() < 0.01 and spread[3:].max() < 0.1  # they were unknown to 0.05 rad/s and 0.3 m/s^2
    assert ran["receiver"].counts.placed == len(ran["stamps"]) and ran["imu"].counts.unknown == 0


@run_by_draw
def test_joint_past_future(run: Run) -> None:
    ran = run("joint_past_future")
    assert list(ran["results"]) == ["sequential", "joint"]
    for away, off, converged in ran["results"].values():
        assert away < 0.4 and off < 0.1  # a position is measured to 0.1 m in each coordinate, three times in four
        assert converged == 60


@pytest.mark.product(1, of="scenes and pictures")
@run_by_draw
def test_own_robot_loop(run: Run) -> None:
    ran = run("own_robot_loop")
    assert list(ran["results"]) == ["sequential", "joint"]
    for away, friction, converged in ran["results"].values():
        assert away < 0.03
        assert friction == pytest.approx([0.8, 0.4], abs=0.05)
        assert converged > 55


@run_by_draw
def test_own_group(run: Run) -> None:
    ran = run("own_group")
    x, S2 = ran["x"], ran["S2"]
    assert fg.check_manifold(S2).ok and "8 axioms hold" in ran.printed
    routes = ran["graph"].check(ran["guess"]).routes
    assert set(routes.values()) == {"traced, its derivatives exact"}
    for solution in ran["solutions"]:
        assert right(ran["graph"], solution)
        steps = np.linalg.norm(S2.local(solution[x][:-1], solution[x][1:]), axis=1)
        assert (
            np.degrees(steps.sum()) == pytest.approx(ran["shortest"], abs=5e-3) and np.ptp(steps) < 1e-2 * steps.mean()
        )
        assert (solution[x] @ ran["sun"]).max() < np.cos(ran["away"]) + 1e-6


@run_by_draw
def test_real_time_iteration(run: Run) -> None:
    ran = run("real_time_iteration")
    best = ran["results"]["to the end"][0]
    assert list(ran["results"]) == ["to the end", "one program", "one step"]
    for cost, driven in ran["results"].values():
        assert cost < 1.005 * best
        assert np.abs(driven[-20:, 0] + 0.5).max() < 0.3 and np.abs(fg.wrap_angle(driven[:, 1] - np.pi)).max() < 0.5
        assert np.abs(driven[:, 0]).max() < 1.21  # a plan keeps to 1.2, the world is not the plan


@run_by_draw
def test_quadrotor_figure8(run: Run) -> None:
    ran = run("quadrotor_figure8")
    assert len(ran["results"]) == 3
    for off, tilt, status in ran["results"].values():
        assert off < 0.04 and 20.0 < tilt < 35.0 and status is fg.Status.CONVERGED


@run_by_draw
def test_range_only_slam(run: Run) -> None:
    ran = run("range_only_slam")
    assert ran["echoes"].sum() > 40
    (plain, off, sigmas, _), *robust = ran["results"].values()
    assert plain.converged and off > 1.0 and sigmas > 10.0  # sure of what is wrong
    for solution, off, sigmas, misjudged in robust:
        assert solution.converged and off < 0.4 and sigmas < 3.0 and misjudged < 6
    assert ran["results"]["GNC"][0].verdict is not None


@run_by_draw
def test_casadi_model(run: Run) -> None:
    pytest.importorskip("casadi")
    ran = run("casadi_model")
    state = ran["state"]
    for solution in ran["solutions"].values():
        assert right(ran["graph"], solution)
        assert np.abs(solution[state][:, 1]).max() == pytest.approx(0.1, abs=1e-6)
        reached = ran["ends"][0]
        for push in solution[ran["push"]]:
            reached = np.asarray(ran["step"](reached, push)).ravel()
        assert np.allclose(reached, [4.0, 0.0, 0.0, 0.0], atol=1e-5)


@run_by_draw
def test_casadi_model_says_what_is_missing(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(SystemExit, match=r'pip install "unifg\[casadi\]"'):
        run("casadi_model")


@run_by_draw
def test_own_backend_constrained(run: Run) -> None:
    """On the table of problems: test_own_backend.py."""
    ran = run("own_backend_constrained")
    own, kkt, augmented = ran["solutions"]
    for solution in (own, kkt, augmented):
        assert right(ran["graph"], solution)
        assert np.allclose(solution.dual("motion"), kkt.dual("motion"), atol=1e-3)
    assert own.iterations <= 20 and kkt.iterations <= 8  # which turns to second derivatives


@run_by_draw
def test_own_qp_solver(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    import qpsolvers

    for names in ("available_solvers", "dense_solvers"):  # it adds itself
        monkeypatch.setattr(qpsolvers, names, list(getattr(qpsolvers, names)))
    monkeypatch.setitem(qpsolvers.solvers.solve_function, "mehrotra", None)
    ran = run("own_qp_solver")
    assert {"mehrotra", "piqp"} <= set(ran["solutions"])
    for name, solution in ran["solutions"].items():
        assert right(ran["graph"], solution), name
        assert solution.cost == pytest.approx(8.257403, abs=1e-5), name
    own = ran["solutions"]["mehrotra"]
    assert {row.details["qp"] for row in own.history[1:]} == {"mehrotra"}


@run_by_draw
def test_scene_of_my_graph(run: Run) -> None:
    ran = run("scene_of_my_graph")
    x, solution = ran["x"], ran["solution"]
    off = np.linalg.norm((solution[x] - ran["truth"])[:, :3], axis=1)
    drifted = np.linalg.norm((ran["guess"] - ran["truth"])[:, :3], axis=1)
    assert solution.converged and off[-1] < 0.5 * drifted[-1]
    for name, title in {"solution": "A tower", "iterates": "How it was solved", "flight": "A flight"}.items():
        text = (ran.folder / f"{name}.html").read_text(encoding="utf-8")
        assert title in text and "http://" not in text.split("<script", 1)[0]
    assert {"x", "truth"} <= set(ran["scene"].layers)


@run_by_draw
def test_live_view(run: Run) -> None:
    ran = run("live_view")
    assert re.search(r"open http://127\.0\.0\.1:\d+/", ran.printed)
    assert ran["live"].watching == 0 and len(ran["scene"].shots) == ran["ticks"]
    assert np.linalg.norm(ran["pose"][:2] - ran["goal"][:2]) < 0.15
    driven = np.array([shot.trails["driven"] for shot in ran["scene"].shots])
    gaps = np.linalg.norm(driven[:, None, :2] - ran["discs"][:, :2], axis=2) - ran["discs"][:, 2]
    assert 0.15 - 1e-3 < gaps.min() < 0.2
    assert "Live" in (ran.folder / "live_view.html").read_text(encoding="utf-8")


@run_by_draw
def test_first_order_tick(run: Run) -> None:
    """The corrected tick is nearer to the full one by far, except where the plan changes sides."""
    ran = run("first_order_tick")
    uncorrected, corrected = ran["table"][:, 2:4].T
    assert np.median(corrected) < 0.05 * np.median(uncorrected) and (corrected < uncorrected).mean() > 0.95
    assert np.median(ran["table"][:, 4]) < 100.0, "microseconds"
    gaps = np.linalg.norm(ran["table"][:, :2] - [2.6, -0.1], axis=1) - 0.3
    assert gaps.min() > -0.05


@pytest.mark.product(1, of="scenes and pictures")
@run_by_draw
def test_branching_plan(run: Run) -> None:
    """Both cases are left room for, at less than a fifth of the time that plans for the worst lose."""
    driven, line = run("branching_plan")["driven"], 12.0
    free = {kind: len(driven(kind, False)) for kind in ("the worst", "the likeliest", "both")}
    assert free["both"] - free["the likeliest"] < 0.2 * (free["the worst"] - free["the likeliest"])
    stopped = {kind: driven(kind, True)[-1, 0] for kind in free}
    assert max(stopped["the worst"], stopped["both"]) < line + 1e-3 and stopped["the likeliest"] > line + 0.5


@run_by_draw
def test_many_plans(run: Run) -> None:
    ran = run("many_plans")
    assert ran["found"].converged and 0.2 * ran["K"] < ran["above"].sum() < 0.8 * ran["K"]


@run_by_draw
def test_explained_plan(run: Run) -> None:
    ran = run("explained_plan")
    for what, saved in ran["saved"].items():
        assert 1e-3 * abs(ran["foretold"][what]) == pytest.approx(saved, rel=0.1)
    assert "'disc' holds the solution" in ran["solution"].explain()


@run_by_draw
def test_checked_answer(run: Run) -> None:
    """A change of ten times the tolerance is found, a hundredth of it is not."""
    ran = run("checked_answer")
    assert ran["sound"]
    for (name, size), verdict in ran["found"].items():
        assert size > 1e-7 or verdict, name
        assert size < 5e-6 or verdict.verdict == "fails", name


@pytest.mark.product(1, of="scenes and pictures")
@run_by_draw
def test_deployed_loop(run: Run) -> None:
    if shutil.which("cc") is None:
        pytest.skip("there is no C compiler")
    ran = run("deployed_loop")
    assert ran["same"] and ran["drive"][-1, 0] > 1.8


@run_by_draw
def test_bundle_adjustment(run: Run) -> None:
    ran = run("bundle_adjustment")
    assert ran["errors"]["Cauchy"] < 0.25 * min(ran["errors"]["squares"], ran["errors"]["triangulated"])
    assert ran["focal"]["Cauchy"].mean() == pytest.approx(800.0, rel=0.005)


@run_by_draw
def test_influential_measurements(run: Run) -> None:
    ran = run("influential_measurements")
    for moved, foretold, true in ran["results"].values():
        assert moved > 0.05 and np.linalg.norm(foretold - true) < 0.1 * np.linalg.norm(true)
    assert ran["moved"].max() > 20.0 * np.median(ran["moved"])


@run_by_draw
def test_learned_weights(run: Run) -> None:
    """The gradient is that of the drive, and it leads down."""
    ran = run("learned_weights")
    costs = [cost for cost, *_ in ran["runs"]]
    assert costs[-1] < 0.9 * costs[0] and len(costs) == 21
    drive, logs, h = ran["drive"], np.array([0.1, -0.2, 0.3]), 1e-5
    for k, slope in enumerate(drive(np.exp(logs))[1]):
        step = h * np.eye(3)[k]
        assert (drive(np.exp(logs + step))[0] - drive(np.exp(logs - step))[0]) / (2.0 * h) == pytest.approx(
            slope, rel=1e-5
        )


@run_by_draw
def test_learned_noise(run: Run) -> None:
    """On drives that were not seen it is as good as with the sigmas that they were made with."""
    ran = run("learned_noise")
    assert ran["costs"][-1] < 0.25 * ran["costs"][0]
    total, sigmas = 0.0, ran["sigmas"]
    for truth, data in ran["drives"][6:]:
        known = {**data, sigmas[0]: ran["noise"], sigmas[1]: np.full(2, ran["gps"])}
        total += float(((ran["run"].solve({ran["x"]: truth}, data=known)[ran["x"]] - truth)[:, :2] ** 2).sum())
    assert ran["costs"][-1] < 1.05 * np.sqrt(total / 360)
