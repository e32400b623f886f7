"""Two manoeuvres, two backends: what must come out, what is kept of the way there, and what is drawn and written."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.lines import Line2D

import unifg as fg
from judge import judge
from problems.graphs import drawn_to
from scenes import check_offline, commands_of, data_of, tracks_of
from unifg.models import unicycle
from unifg.scenarios import command
from unifg.scenarios.manoeuvres import (
    CASES,
    Manoeuvre,
    ManoeuvreSettings,
    case_metrics,
    run_manoeuvre,
    state_problem,
    table,
)
from unifg.scenarios.scenes import manoeuvre_plot as manoeuvre_plots
from unifg.scenarios.scenes.manoeuvre_scene import manoeuvre_scene
from unifg.solvers import SQP, names
from unifg.style.colours import css
from unifg.typing import Array

SOLVERS = ("alm", "sqp")
BEHIND = 59.47520  # J of the path behind the robot without a cost on changes, by IPOPT and by Crocoddyl's Box-FDDP


@cache
def solved(name: str, solver: str) -> Manoeuvre:
    return run_manoeuvre(CASES[name], solver)


both = pytest.mark.parametrize("solver", SOLVERS)
all_cases = pytest.mark.parametrize("name", CASES)


@all_cases
@both
def test_converges_within_every_limit(name: str, solver: str) -> None:
    m = solved(name, solver)
    assert m.solution.status is fg.Status.CONVERGED
    assert max(m.solution.stationarity, m.solution.violation, m.solution.complementarity) <= 1e-6
    assert m.succeeded and m.within_limits
    assert np.abs(m.controls).max() <= 1.0 + 1e-9
    np.testing.assert_array_equal(m.states[0], CASES[name].start)
    driven = unicycle.rollout(m.states[0], m.controls, m.settings.dt)
    np.testing.assert_allclose(driven[:, :2], m.states[:, :2], atol=1e-6)
    assert np.abs(fg.wrap_angle(driven[:, 2] - m.states[:, 2])).max() < 1e-6


@all_cases
@both
@pytest.mark.product(2)
def test_an_independent_judge_agrees(name: str, solver: str) -> None:
    settings = ManoeuvreSettings()
    graph, _, _, guess = state_problem(CASES[name], settings)
    backend = names.backend(solver, max_iterations=300)
    solution = backend.solve(graph, guess)
    assert judge(graph, solution).worst() < 5e-6
    assert solution.cost == pytest.approx(solved(name, solver).solution.cost, rel=1e-12)
    assert all(row.values is None for row in solution.history)  # values are kept only on request


@all_cases
def test_both_backends_find_the_same_manoeuvre(name: str) -> None:
    first, second = (solved(name, solver) for solver in SOLVERS)
    assert first.solution.cost == pytest.approx(second.solution.cost, rel=1e-7)
    np.testing.assert_allclose(first.states[:, :2], second.states[:, :2], atol=1e-4)


@both
def test_without_a_cost_on_changes_it_is_the_published_optimum(solver: str) -> None:
    m = run_manoeuvre(CASES["behind"], solver, ManoeuvreSettings(change=(0.0, 0.0)))
    assert m.solution.converged
    assert m.solution.cost == pytest.approx(BEHIND, rel=1e-6)
    assert len(m.cusps) == 1


@both
def test_behind_has_one_cusp(solver: str) -> None:
    m = solved("behind", solver)
    v = m.controls[:, 0]
    (cusp,) = m.cusps
    assert (v[:cusp] < 0.0).all() and (v[cusp:] > 0.0).all()
    assert abs(v[cusp - 1]) < 0.15 and abs(v[cusp]) < 0.15  # it passes through rest and does not jump
    assert v.min() == pytest.approx(-1.0, abs=1e-6)
    assert m.controls[:, 1].max() == pytest.approx(1.0, abs=1e-6)
    # A cusp of the way: the robot hardly turns its heading there, but the direction of travel turns round.
    before, after = m.states[cusp, :2] - m.states[cusp - 2, :2], m.states[cusp + 2, :2] - m.states[cusp, :2]
    assert before @ after < -0.8 * np.linalg.norm(before) * np.linalg.norm(after)
    np.testing.assert_allclose(m.states[-1, :2], [-2.5, 0.0], atol=0.02)


@both
def test_the_guess_hits_the_disc_and_the_answer_does_not(solver: str) -> None:
    m = solved("obstacle", solver)
    x, y, radius = m.case.discs[0]
    assert np.hypot(*(m.iterates[0, :, :2] - [x, y]).T).min() < 0.5 * radius
    gaps = np.hypot(*(m.states[:, :2] - [x, y]).T) - radius - m.settings.robot_radius
    assert gaps.min() >= m.settings.clearance - 1e-6 >= 0.0
    assert gaps.min() == pytest.approx(m.settings.clearance, abs=1e-6)  # it passes as near as it may
    assert m.clearance_between > m.settings.clearance - 0.003
    assert m.clearance.min() == pytest.approx(gaps.min(), abs=1e-12)


@both
def test_omega_turns_over_at_the_inflections_where_v_is_greatest(solver: str) -> None:
    m = solved("obstacle", solver)
    v, omega = m.controls.T
    assert m.cusps == [] and len(m.inflections) == 2
    for k in m.inflections:
        assert omega[k - 1] * omega[k] < 0.0
        assert max(v[k - 1], v[k]) > 0.95
    assert omega.min() == pytest.approx(-1.0, abs=1e-6)


@both
def test_the_guess_chooses_the_side(solver: str) -> None:
    graph, x, _, guess = state_problem(CASES["obstacle"], ManoeuvreSettings())
    guess.values[x][1:, 1] -= 0.2
    backend = names.backend(solver, max_iterations=300)
    below = backend.solve(graph, guess, check=True)
    assert below.cost == pytest.approx(29.5439, rel=1e-5)
    assert below[x][25, 1] < -0.5 and solved("obstacle", solver).states[25, 1] > 0.4


@all_cases
@both
def test_iterates_begin_with_the_guess_and_end_with_the_answer(name: str, solver: str) -> None:
    m = solved(name, solver)
    _, x, _, guess = state_problem(m.case, m.settings)
    np.testing.assert_array_equal(m.iterates[0], guess.values[x])
    np.testing.assert_array_equal(m.iterates[-1], m.states)
    assert len(m.iterates) == m.solution.iterations + 1 > 5
    moved = np.abs(np.diff(m.iterates[:, :, :2], axis=0)).max(axis=(1, 2))
    assert moved[0] > 0.01 and (m.iterates[1:-1, :, :2] != m.iterates[-1, :, :2]).any(axis=(1, 2)).all()


def test_kept_values_are_copies() -> None:
    graph, x = drawn_to([3.0])
    graph.bound(x, upper=1.0)
    solution = SQP(keep_values=True).solve(graph, {x: np.zeros((1, 1))})
    first, last = solution.history[0].values, solution.history[-1].values
    assert first is not None and last is not None
    assert first[x] == 0.0 and last[x] == pytest.approx(1.0)
    last[x][:] = 7.0
    assert solution[x] == pytest.approx(1.0)


def test_progress_can_stop_a_solve() -> None:
    m = run_manoeuvre(CASES["behind"], "alm", progress=lambda row: row.number == 3)
    assert m.solution.status is fg.Status.INTERRUPTED
    assert not m.succeeded
    assert len(m.iterates) == 4


def test_a_broken_limit_is_no_success() -> None:
    m = solved("obstacle", "sqp")
    assert not replace(m, controls=m.controls * 1.001).succeeded
    assert not replace(m, states=m.iterates[0]).within_limits
    assert "NO" in table([replace(m, controls=m.controls * 1.001)])


def test_small_controls_are_no_reversals() -> None:
    m = solved("behind", "sqp")
    v = np.array([-1.0, -0.1, 1e-9, -1e-9, 0.0, 0.2, 0.4, -1e-5, 0.3, -0.5])
    made_up = replace(m, controls=np.column_stack([v, np.ones_like(v)]))
    assert made_up.cusps == [5, 9]
    assert made_up.inflections == []


@all_cases
def test_picture_shows_what_happened(name: str) -> None:
    m = solved(name, "alm")
    figure = manoeuvre_plots.picture(m)
    place, speed, turning, convergence = figure.axes
    handles, labels = place.get_legend_handles_labels()
    keys = dict(zip(labels, handles, strict=True))
    guess = keys["first iterate: the guess, on the path"]
    np.testing.assert_array_equal(np.column_stack(guess.get_data()), m.iterates[0, :, :2])
    assert guess.get_linestyle() == "--" and to_hex(guess.get_color()) == css("horizon")
    assert {f"last iterate ({m.solution.iterations}): the optimum", "robot and its front, every 0.5 s"} <= keys.keys()
    drawn: dict[str, list[Array]] = {}
    for part in place.collections:
        if isinstance(part, PolyCollection):
            vertices = np.concatenate([np.asarray(path.vertices) for path in part.get_paths()])
            drawn.setdefault(to_hex(np.asarray(part.get_facecolor())[0], keep_alpha=True), []).append(vertices)
    (last,) = drawn[css("robot") + "ff"]
    np.testing.assert_allclose(last.min(axis=0), m.states[:, :2].min(axis=0), atol=0.03)
    np.testing.assert_allclose(last.max(axis=0), m.states[:, :2].max(axis=0), atol=0.03)
    robots = drawn[css("robot") + "21"]
    sizes = [float(np.ptp(robot, axis=0).max()) for robot in robots]  # discs are polygons
    np.testing.assert_allclose(sizes, [2.0 * m.settings.robot_radius] * 11, rtol=1e-2)
    assert sum(len(one) for shade, one in drawn.items() if shade.endswith("ff")) >= len(m.iterates) - 1
    words = {text.get_text() for text in place.texts}
    assert {"start", "goal"} <= words
    assert any("cusp at 1.0 s" in word for word in words) == (name == "behind")
    assert ("cusp: v passes through 0" in keys) == (name == "behind") and "inflection: $\\omega$ changes sign" in keys
    for (x, y, radius), disc in zip(m.case.discs, drawn.get(css("fixed") + "ff", []), strict=True):
        np.testing.assert_allclose(
            [disc.min(axis=0), disc.max(axis=0)], [[x - radius, y - radius], [x + radius, y + radius]]
        )
        assert place.get_xlim()[0] < x < place.get_xlim()[1] and "the robot's centre stays outside" in keys
    for axes, column in ((speed, 0), (turning, 1)):
        (curve,) = (line for line in axes.lines if len(line.get_xdata()) == m.settings.horizon + 1)  # type: ignore[arg-type]
        np.testing.assert_array_equal(np.asarray(curve.get_ydata())[:-1], m.controls[:, column])
        assert axes.get_ylim()[0] < -1.0 and axes.get_ylim()[1] > 1.0
        vertical = [float(np.asarray(line.get_xdata())[0]) for line in axes.lines if _is_vertical(line)]
        assert vertical == m.time[m.cusps + m.inflections].tolist()
    (dots,) = convergence.collections
    assert len(np.asarray(dots.get_offsets())) == len(m.iterates)


def test_shades_go_from_green_through_whitening_pink_to_blue() -> None:
    shades = manoeuvre_plots.shades(12)
    assert tuple(shades[0]) == to_rgb(css("horizon")) and tuple(shades[-1]) == to_rgb(css("robot"))
    assert (np.diff(shades[1:-1].sum(axis=1)) > 0.0).all()
    for count in (1, 2, 3):
        assert manoeuvre_plots.shades(count).shape == (count, 3)


@pytest.mark.parametrize("name", sorted(CASES))
def test_the_scene_drives_what_was_found(name: str) -> None:
    manoeuvre = solved(name, "sqp")
    page = manoeuvre_scene(manoeuvre).html()
    check_offline(page)
    data, tracks = data_of(page), tracks_of(commands_of(page))
    places = np.array([place for _, place in tracks["robot"][".position"]])
    np.testing.assert_allclose(places[:, :2], manoeuvre.states[:, :2])
    assert data["good"] is True and data["dt"] == manoeuvre.settings.dt
    plots = {plot["name"]: plot["values"] for plot in data["plots"]}
    np.testing.assert_allclose(plots["forward speed"][:-1], manoeuvre.controls[:, 0])
    assert ("clearance" in plots) == bool(manoeuvre.case.discs)
    assert data["readouts"][0]["texts"][0] == ("backward" if name == "behind" else "forward")


@both
@pytest.mark.product(1, of="scenes and pictures")
def test_command_writes_its_files(solver: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["run", "manoeuvres", "--solver", solver, "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr()
    for name in ("behind.png", "obstacle.png", "metrics.json", "behind.html", "obstacle.html"):
        assert str(tmp_path / "out" / name) in said.out.splitlines()
        largest = 2_000_000 if name.endswith("html") else 250_000  # a scene carries its viewer
        assert 0 < (tmp_path / "out" / name).stat().st_size < largest
    assert "all limits kept" in said.out and "1, at 1.0 s" in said.out
    assert "done in" in said.err and "done in" not in said.out
    found = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert found["solver"] == solver and list(found["cases"]) == ["behind", "obstacle"]
    behind, obstacle = found["cases"]["behind"], found["cases"]["obstacle"]
    assert (behind["cusps"], behind["cusp_times_s"], behind["min_clearance_m"]) == (1, [1.0], None)
    assert (obstacle["cusps"], len(obstacle["inflection_times_s"])) == (0, 2)
    assert obstacle["min_clearance_m"] == pytest.approx(0.03, abs=1e-6)
    expected = dict(case_metrics(solved("obstacle", solver)))
    assert {**obstacle, "solve_ms": 0.0} == {**expected, "solve_ms": 0.0}


@pytest.mark.usefixtures("undrawn")
def test_command_fails_when_a_solve_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(CASES, "behind", replace(CASES["behind"], discs=((0.0, 0.0, 0.5),)))  # it starts inside
    assert command.main(["run", "manoeuvres", "--case", "behind", "--out", str(tmp_path)]) == 1
    numbers = json.loads((tmp_path / "metrics.json").read_text())["cases"]["behind"]
    assert not numbers["converged"] and numbers["status"] != "converged"
    assert {file.name for file in tmp_path.iterdir()} == {"behind.html", "behind.png", "metrics.json"}


@pytest.mark.usefixtures("undrawn")
def test_an_interrupt_ends_the_run_and_writes_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from unifg.scenarios import manoeuvres

    def stopped(case: object, solver: str, progress: object) -> Manoeuvre:
        return run_manoeuvre(CASES["behind"], solver, progress=lambda row: row.number == 2)

    monkeypatch.setattr(manoeuvres, "run_manoeuvre", stopped)
    assert command.main(["run", "manoeuvres", "--out", str(tmp_path)]) == command.INTERRUPTED
    assert {file.name for file in tmp_path.iterdir()} == {"behind.html", "behind.png", "metrics.json"}


def test_command_refuses_other_cases_and_seeds(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["run", "manoeuvres", "--case", "sideways", "--out", str(tmp_path)]) == 2
    assert "invalid choice: 'sideways'" in capsys.readouterr().err
    assert command.main(["run", "manoeuvres", "--seed", "1", "--out", str(tmp_path)]) == 2  # nothing here is random


def _is_vertical(line: Line2D) -> bool:
    x = np.asarray(line.get_xdata())
    return len(x) == 2 and bool(x[0] == x[1])
