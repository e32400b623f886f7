"""The flight past three walls and a cylinder: what must come out, what must be noticed, what is drawn and written."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from benchmarks.obstacle_courses import METHODS, distinct, lowest, render
from judge import judge
from unifg.errors import BackendError, ScenarioError
from unifg.models import quadrotor
from unifg.scenarios import command
from unifg.scenarios import course as obstacles
from unifg.scenarios.commands.courses import course_metrics, summary
from unifg.scenarios.course import (
    HESSIANS,
    Course,
    CourseSettings,
    backend,
    course_guess,
    run_course,
    state_problem,
)
from unifg.scenarios.papers.courses import Method, Outcome
from unifg.scenarios.scenes.course_log import course_log
from unifg.scenarios.scenes.course_plot import chosen_iterates, picture, plot_above
from unifg.scenarios.simulation.air import VEHICLE_RADIUS
from unifg.scenarios.simulation.layouts import Layout, obstacle_course

BACKENDS = (("sqp", "exact"), ("sqp", "gauss-newton"), ("ipm", "exact"), ("ipm", "gauss-newton"), ("alm", "exact"),
            ("alm", "gauss-newton"))  # fmt: skip
POTENTIAL, HARD = 61.2071, 29.8606  # costs of the nominal layout, on which all six pairs agree


@cache
def flown(**changes: object) -> Course:
    return run_course(CourseSettings(**changes))  # type: ignore[arg-type]


@pytest.mark.parametrize(("solver", "hessian"), BACKENDS)
@pytest.mark.parametrize(("avoidance", "cost"), [("potential", POTENTIAL), ("hard", HARD)])
def test_every_backend_finds_the_same_flight(solver: str, hessian: str | None, avoidance: str, cost: float) -> None:
    course = flown(solver=solver, hessian=hessian, avoidance=avoidance)
    s = course.settings
    assert course.solution.status is fg.Status.CONVERGED
    assert course.solution.cost == pytest.approx(cost, abs=1e-3)
    assert course.succeeded and course.arrived and course.clear and course.flyable
    assert course.clearance[1:].min() >= (s.clearance - 1e-6 if avoidance == "hard" else 0.3)
    assert course.clearance.min() - 0.04 < course.clearance_between <= course.clearance.min()
    np.testing.assert_array_equal(course.states[0], [*course.layout.start, 1, 0, 0, 0, 0, 0, 0])
    again = quadrotor.rollout(course.states[0], course.controls, s.dt, s.vehicle)
    np.testing.assert_allclose(again[:, [0, 1, 2, 7, 8, 9]], course.states[:, [0, 1, 2, 7, 8, 9]], atol=1e-4)
    assert course.states[:, 2].min() >= -1e-6
    assert np.abs(course.states[:, 7:]).max() <= s.speed_limit + 1e-6
    assert course.drift < 0.1  # the trapezoid of 0.1 s against a fine integrator, over the whole flight


@pytest.mark.parametrize(("solver", "way"), [("sqp", "potential"), ("ipm", "hard")])
def test_an_independent_judge_agrees(solver: str, way: str) -> None:
    settings = CourseSettings(solver=solver, avoidance=way, horizon=20, dt=0.25)  # type: ignore[arg-type]
    layout = settings.layout()
    graph, x, u = state_problem(settings, layout)
    states, controls = course_guess(replace(settings, guess="way"), layout)
    solution = backend(settings).solve(graph, {x: states, u: controls}, check=True)
    assert judge(graph, solution).worst() < 5e-6


def test_the_exact_hessian_saves_iterations() -> None:
    exact, rough = flown(solver="sqp", hessian="exact"), flown(solver="sqp", hessian="gauss-newton")
    assert 2 * exact.solution.iterations <= rough.solution.iterations


@pytest.mark.parametrize("solver", ["sqp", "ipm", "alm"])
def test_a_general_cost_and_its_square_are_the_same_problem(solver: str) -> None:
    general, square = flown(solver=solver, general=True), flown(solver=solver)
    assert general.succeeded
    assert general.solution.cost == pytest.approx(square.solution.cost, abs=1e-5)
    np.testing.assert_allclose(general.states, square.states, atol=1e-4)


def test_a_local_minimum_is_no_success() -> None:
    course = flown(avoidance="hard", guess="hover")
    assert course.solution.converged and course.clear and course.flyable
    assert course.target_distance > 1.0
    assert not course.arrived and not course.safe and not course.succeeded


def test_a_wall_crossed_between_two_nodes_is_a_collision() -> None:
    wall = np.array([[[1.0, -2.0], [1.0, 2.0]]])
    layout = Layout(np.zeros(3), np.array([2.0, 0.0, 0.0]), np.zeros((0, 3)), wall, np.array([[-1, -2], [3, 2]]))
    settings = CourseSettings(horizon=2, dt=1.0)
    hover = quadrotor.hover(settings.vehicle)
    states = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 2.0, 0.0, 0.0], (3, 1))
    states[:, 0] = [-1.4, 0.6, 2.6]
    graph, x, u = state_problem(settings, layout)
    solution = backend(replace(settings, avoidance="hard")).solve(graph, {x: states, u: np.tile(hover, (2, 1))})
    course = Course(settings, layout, solution, states, np.tile(hover, (2, 1)), states[None])
    assert course.flyable
    assert course.clearance.min() == pytest.approx(0.4 - VEHICLE_RADIUS)
    assert course.clearance_between == pytest.approx(-VEHICLE_RADIUS)
    assert not course.clear
    bent = states.copy()
    bent[1, 1] += 0.01
    assert not replace(course, states=bent).flyable
    assert not replace(course, controls=course.controls - [0.0, 0.0, 0.0, 11.0]).flyable


def test_guesses() -> None:
    settings, layout = CourseSettings(), obstacle_course()
    hover, _ = course_guess(replace(settings, guess="hover"), layout)
    line, _ = course_guess(replace(settings, guess="line"), layout)
    way, controls = course_guess(replace(settings, guess="way"), layout)
    assert (hover == hover[0]).all()
    assert layout.distance(line[:, :2]).min() < 0.1 and layout.distance(way[:, :2]).min() > 0.5
    for states in (line, way):
        np.testing.assert_allclose(states[-1, :3], layout.target, atol=1e-12)
        np.testing.assert_allclose(states[:-1, :3] + settings.dt * states[1:, 7:], states[1:, :3], atol=1e-12)
    assert (controls == quadrotor.hover(settings.vehicle)).all()
    assert settings.guess == "way"


@pytest.mark.parametrize("solver", ["sqp", "ipm", "alm"])
def test_the_hessian_that_is_asked_for_is_used(solver: str) -> None:
    assert CourseSettings(solver=solver).hessian == "exact"
    for hessian in HESSIANS:
        assert backend(CourseSettings(solver=solver, hessian=hessian)).hessian == hessian  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"solver": "newton"}, "unknown backend 'newton'"),
        ({"guess": "luck"}, "unknown guess"),
        ({"solver": "penalty", "general": True}, "Penalty has no option 'hessian'"),
        ({"avoidance": "hard", "general": True}, "general: a general cost states the potential, and avoidance 'hard'"),
    ],
)
def test_what_cannot_be_asked_for(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises((BackendError, ScenarioError), match=words):
        run_course(CourseSettings(**wrong))


def test_a_guess_along_a_way_needs_one() -> None:
    corners = np.array([[1.0, -1.0], [3.0, -1.0], [3.0, 1.0], [1.0, 1.0]])
    box = np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)
    closed = Layout(np.zeros(3), np.array([2.0, 0.0, 1.0]), np.zeros((0, 3)), box, np.array([[-1, -2], [4, 2]]), "box")
    with pytest.raises(ScenarioError, match=r"'box' has no way of clearance 0\.3 m"):
        course_guess(CourseSettings(guess="way"), closed)


@pytest.mark.product(1, of="scenes and pictures")
def test_pictures_show_four_iterates_and_every_number() -> None:
    course = flown(guess="hover")
    assert len(course.iterates) == course.solution.iterations + 1
    np.testing.assert_array_equal(course.iterates[-1], course.states)
    assert chosen_iterates(1) == [0] and chosen_iterates(3) == [0, 1, 2] and chosen_iterates(41) == [0, 1, 13, 40]
    figure = picture(course)
    axes = figure.get_axes()
    assert len(axes) == 10
    assert [line.get_xydata().shape[0] for line in axes[-1].lines] == [len(course.iterates), 4]  # type: ignore[union-attr]
    first = plot_above(course, 1, axes[0])
    labels = first.get_legend_handles_labels()[1]
    assert "node where the hull would touch" in labels  # the first step leads through a wall


def test_the_log_is_the_flight() -> None:
    course = flown()
    log = course_log(course)
    assert log.ticks == 4 * course.settings.horizon + 1 and log.dt == pytest.approx(0.025)
    np.testing.assert_allclose(log.truth[::4], course.states, atol=1e-6)
    np.testing.assert_allclose(log.plans[:, -1], np.tile(course.states[-1, :3], (log.ticks, 1)))
    assert log.succeeded and "seed" not in log.settings
    assert log.clearance.min() == pytest.approx(course.clearance_between, abs=1e-2)
    assert not course_log(flown(avoidance="hard", guess="hover")).reached


def test_numbers_and_words() -> None:
    course = flown()
    numbers = course_metrics(course)
    assert len(numbers["costs"]) == len(numbers["violations"]) == numbers["iterations"] + 1
    assert numbers["costs"][-1] == pytest.approx(numbers["cost"])
    assert 0.0 < numbers["max_tilt_rad"] < 0.6 and numbers["path_length_m"] > 8.0
    assert "arrived" in summary(course) and "clear" in summary(course)
    assert "NOT ARRIVED" in summary(flown(avoidance="hard", guess="hover"))


@pytest.mark.product(1, of="scenes and pictures")
@pytest.mark.usefixtures("undrawn")
def test_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "quadrotor-obstacles", "--out", str(tmp_path)]
    assert command.main([*words, "--solver", "ipm", "--avoidance", "hard", "--seed", "1003"]) == 0
    assert "obstacle course 1003" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "iterates.png",
        "metrics.json",
        "scene.html",
    ]
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["succeeded"] and metrics["guess"] == "way" and metrics["layout"] == "obstacle course 1003"
    assert command.main([*words, "--seed", "-1"]) == 2


def test_the_command_line_reports_failure(tmp_path: Path) -> None:
    words = ["run", "quadrotor-obstacles", "--avoidance", "hard", "--guess", "hover", "--out", str(tmp_path)]
    assert command.main(words) == 1


def test_the_command_line_offers_what_the_scenario_has(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["run", "quadrotor-obstacles", "--help"]) == 0
    said = capsys.readouterr().out
    for name in ("HESSIANS", "AVOIDANCES", "GUESSES"):
        assert "{" + ",".join(getattr(obstacles, name)) + "}" in said


def test_statistics_of_the_study() -> None:
    assert distinct([]) == 0 and distinct([1.0, 1.0 + 1e-6, 1.01, 5.0]) == 3
    good = Outcome("converged", True, True, True, True, 2.0, 0.0, 0.1, 5, 1.0)
    results = {method: [good] for method in METHODS}
    cheap = Method("potential", "way", "ipm", "exact")
    results[cheap] = [replace(good, cost=1.0, clear=False)]
    results[Method("hard", "line", "ipm", "exact")] = [replace(good, cost=0.5, converged=False)]
    assert [o and o.cost for o in lowest(results, "potential")] == [1.0]
    assert [o and o.cost for o in lowest(results, "hard")] == [2.0]
    text = render(results, [obstacle_course()])
    assert "| potential | 0 | 1 | 0 | 0 | 2 | 1 | 1 | 0 |" in text
    assert "| potential | way | ipm, exact | 0 | 0 to 79 % | 1 | 0 | 1 | 1 | 5 | 1 |" in text
