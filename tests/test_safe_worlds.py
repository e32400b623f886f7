"""The truth of flights that must keep their distance: loops of the vehicle, paths, bodies, and how near it came."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.linalg import expm

from unifg.errors import ScenarioError
from unifg.models import quadrotor
from unifg.models.quadrotor_loops import held
from unifg.scenarios.planning.flat_path import FigureEight, FlatPath, Hover, Line
from unifg.scenarios.simulation.bodies import Bodies, Body, Ellipse, Motion, Shuttle, Still, Thrown
from unifg.scenarios.simulation.body_rate import SUBSTEP, Airframe, BodyRatePlant, Loops

START = np.array([1.0, -2.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.3, 0.0, -0.1])
HEAVY = Airframe(quadrotor.Parameters(1.1, (0.3, 0.3, 0.15)))
TURN = np.array([1.0, -2.0, 0.5, 12.0])


# ---------------------------------------------------------------- loops


@pytest.mark.parametrize("loops", [Loops(), Loops(5.0, 0.1, 0.0), Loops(80.0, 0.004, 0.03)])
def test_loops_are_stepped_exactly(loops: Loops) -> None:
    a = np.array([[0.0, 1.0 / loops.lag], [-loops.gain, -1.0 / loops.lag]])  # of rate and lag rate'
    exact = np.array([expm(SUBSTEP * share * a) for share in np.linspace(0.0, 1.0, 2001)])
    step = held(loops.gain, loops.lag, SUBSTEP)[0]
    np.testing.assert_allclose(step[:4].reshape(2, 2), exact[-1], atol=1e-12, rtol=1e-12)
    np.testing.assert_allclose(step[5:7], trapezoid(exact[:, 0], dx=1.0 / 2000, axis=0), rtol=1e-6, atol=1e-12)
    kept = np.exp(-SUBSTEP * np.linspace(0.0, 1.0, 2001) / loops.lag)
    np.testing.assert_allclose(step[[4, 7]], [kept[-1], trapezoid(kept, dx=1.0 / 2000)], rtol=1e-6)


@pytest.mark.parametrize("wrong", [{"gain": 0.0}, {"lag": -1.0}, {"link": -0.01}, {"gain": float("nan")}])
def test_loops_that_are_none_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ScenarioError, match="is not a"):
        Loops(**wrong)


@pytest.mark.parametrize(("dt", "link"), [(0.0105, 0.0), (0.0, 0.0), (0.01, 0.0004)])
def test_ticks_are_whole_milliseconds(dt: float, link: float) -> None:
    with pytest.raises(ScenarioError, match="no whole number of milliseconds"):
        BodyRatePlant(Airframe(loops=Loops(link=link)), START, dt)


@pytest.mark.parametrize("link", [0.0, 0.01, 0.023])
def test_a_command_acts_one_tick_and_the_link_later(link: float) -> None:
    airframe = replace(HEAVY, loops=Loops(link=link))
    told, quiet = BodyRatePlant(airframe, START, 0.01), BodyRatePlant(airframe, START, 0.01)
    hover = quadrotor.hover(airframe.parameters)
    ways = [np.concatenate([plant.tick(u)[:-1] for _ in range(8)]) for plant, u in ((told, TURN), (quiet, hover))]
    apart = np.flatnonzero(np.abs(ways[0] - ways[1]).max(axis=1) > 0.0)
    assert apart[0] == round((0.01 + link) / SUBSTEP) + 1  # the first millisecond under the command ends there


def test_rates_and_thrust_settle_at_what_is_told_and_thrust_by_its_lag() -> None:
    plant = BodyRatePlant(replace(HEAVY, loops=Loops(link=0.0)), START, 0.01)
    hover = float(plant.loops[6])
    plant.tick(TURN)
    for _ in range(2):
        plant.tick(TURN)
    assert (plant.loops[6] - hover) / (TURN[3] - hover) == pytest.approx(1.0 - np.exp(-1.0), abs=1e-9)
    for _ in range(80):
        plant.tick(TURN)
    np.testing.assert_allclose(plant.loops, [*TURN[:3], 0.0, 0.0, 0.0, TURN[3]], atol=1e-6)


def test_the_way_does_not_depend_on_the_ticks() -> None:
    slow, quick = BodyRatePlant(HEAVY, START, 0.02), BodyRatePlant(replace(HEAVY, loops=Loops(link=0.02)), START, 0.01)
    slow.airframe = quick.airframe
    slow = BodyRatePlant(replace(HEAVY, loops=Loops(link=0.01)), START, 0.02)
    for _ in range(10):
        slow.tick(TURN)
    for _ in range(20):
        quick.tick(TURN)
    np.testing.assert_allclose(slow.state, quick.state, atol=1e-12)
    assert slow.time == pytest.approx(quick.time)


def test_held_loops_fly_as_the_integrator_does() -> None:
    plant = BodyRatePlant(HEAVY, START, 0.01)
    for _ in range(100):
        plant.tick(TURN)
    before, noise = plant.state.copy(), np.array([0.1, 0.0, -0.1, 0.2, 0.0, 0.1])
    plant.tick(TURN, noise)
    after = quadrotor.fly(before, TURN, 0.01, HEAVY.parameters, noise)
    np.testing.assert_allclose(plant.state, after, atol=1e-9)


def test_what_is_pending_predicts_what_happens() -> None:
    plant, rng = BodyRatePlant(HEAVY, START, 0.01), np.random.default_rng(3)
    for _ in range(10):
        plant.tick(TURN * rng.uniform(0.5, 1.5, 4))
    kept = plant.state.copy(), plant.loops.copy(), plant.time
    expected, loops = plant.ahead(plant.state, 0.01 + HEAVY.loops.link)
    for now, before in zip((plant.state, plant.loops), kept, strict=False):
        np.testing.assert_array_equal(now, before)  # looking changes nothing
    for _ in range(2):
        plant.tick(rng.uniform(size=4))  # decided too late to matter
    np.testing.assert_allclose(plant.state, expected, atol=1e-12)
    np.testing.assert_allclose(plant.loops, loops, atol=1e-12)
    longer = plant.ahead(plant.state, 0.5)
    blown = plant.ahead(plant.state, 0.5, [0.0, 0.0, 0.0, 0.0, 0.3, 0.0])
    assert np.isfinite(longer[0]).all()
    assert blown[0][1] - longer[0][1] == pytest.approx(0.5 * 0.3 * 0.5**2, rel=0.05)  # less what drag takes
    np.testing.assert_array_equal(plant.ahead(START, 0.0)[0], START)


def test_commands_beyond_the_limits_are_limited_and_those_that_are_no_numbers_refused() -> None:
    wild, most = BodyRatePlant(HEAVY, START, 0.01), BodyRatePlant(HEAVY, START, 0.01)
    for _ in range(5):
        wild.tick([1e9, -1e9, 1e9, -5.0])
        most.tick([6.0, -6.0, 3.0, 2.0])
    np.testing.assert_array_equal(wild.state, most.state)
    with pytest.raises(ScenarioError, match="must be finite"):
        wild.tick([0.0, 0.0, np.nan, 9.0])


# ---------------------------------------------------------------- paths

PATHS = {
    "line": Line((0.0, 1.0, 2.0), (3.0, -1.0, 1.0), 2.0, 1.5),
    "short line": Line((0.0, 0.0, 1.0), (0.5, 0.0, 1.0), 2.0, 1.5),
    "eight": FigureEight(3.0),
    "hover": Hover((1.0, 2.0, 3.0)),
}


@pytest.mark.parametrize("path", PATHS.values(), ids=list(PATHS))
@pytest.mark.parametrize("k", range(3))
def test_paths_are_differentiated_rightly(k: int, path: FlatPath) -> None:
    times = np.linspace(-0.5, 6.0, 321) + 1e-4  # beside the corners
    h = 1e-5
    ahead, here, behind = path.at(times + h), path.at(times), path.at(times - h)
    corner = np.abs(here[k + 1] - ahead[k + 1]).max(axis=1) + np.abs(here[k + 1] - behind[k + 1]).max(axis=1) > 0.1
    slope = (ahead[k] - behind[k]) / (2.0 * h)
    np.testing.assert_allclose(slope[~corner], here[k + 1][~corner], atol=2e-4)


def test_a_line_is_a_trapezoid() -> None:
    line = PATHS["line"]
    assert isinstance(line, Line)
    flown = line.at(np.array([-1.0, 0.0, 0.5 * line.duration, line.duration, line.duration + 5.0]))
    np.testing.assert_allclose(np.linalg.norm(flown.velocity, axis=1), [0.0, 0.0, 2.0, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(flown.position[[1, 3, 4]], [line.start, line.end, line.end], atol=1e-12)
    short = PATHS["short line"]
    assert isinstance(short, Line)
    top = np.linalg.norm(short.at(np.linspace(0.0, short.duration, 501)).velocity, axis=1).max()
    assert top == pytest.approx(np.sqrt(0.5 * 1.5), rel=1e-3) and top < short.speed
    np.testing.assert_allclose(short.at(np.array([short.duration])).position[0], short.end, atol=1e-12)


def test_an_eight_is_fastest_in_its_crossing() -> None:
    path = FigureEight(2.5)
    speed = np.linalg.norm(path.at(np.linspace(0.0, path.period, 2001)).velocity, axis=1)
    assert speed.max() == pytest.approx(2.5) and speed[0] == pytest.approx(2.5)
    np.testing.assert_allclose(path.at(np.array([0.0, path.period])).position, [[0.0, 0.0, 1.5]] * 2, atol=1e-12)


# ---------------------------------------------------------------- bodies

MOTIONS: dict[str, Motion] = {
    "still": Still((1.0, 2.0, 3.0)),
    "ellipse": Ellipse((0.0, 1.0, 1.5), (2.5, 1.0), 2.4, 0.3),
    "clockwise": Ellipse((0.0, 1.0, 1.5), (1.0, 2.0), 2.4, 0.9, clockwise=True),
    "shuttle": Shuttle((0.0, -1.0, 1.0), (0.0, 2.0, 1.5), 0.8, 0.7),
    "thrown": Thrown((3.0, 0.0, 1.0), (-4.0, 0.5, 3.0), 0.5),
}


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=list(MOTIONS))
def test_motions_are_differentiated_rightly(motion: Motion) -> None:
    times, h = np.linspace(0.0, 8.0, 401) + 1e-4, 1e-5
    (ahead, after), (_, velocity), (behind, before) = (motion.at(times + s) for s in (h, 0.0, -h))
    smooth = np.abs(after - before).max(axis=1) < 0.1
    assert smooth.mean() > 0.95
    np.testing.assert_allclose((ahead - behind)[smooth] / (2.0 * h), velocity[smooth], atol=5e-3)


@pytest.mark.parametrize("name", ["ellipse", "clockwise"])
def test_an_ellipse_is_run_at_constant_speed_and_bends_no_more_than_it_says(name: str) -> None:
    around = MOTIONS[name]
    assert isinstance(around, Ellipse)
    times = np.linspace(0.0, 20.0, 2001)
    place, velocity = around.at(times)
    np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), 2.4)
    np.testing.assert_allclose((((place - around.centre)[:, :2] / around.axes) ** 2).sum(axis=1), 1.0, atol=1e-9)
    bend = np.linalg.norm(np.diff(velocity, axis=0), axis=1) / 1e-2
    greatest = 2.4**2 * max(around.axes) / min(around.axes) ** 2  # where the curve bends most
    assert 0.95 * greatest < bend.max() < 1.05 * greatest
    turn = np.cross(place - around.centre, velocity)[:, 2]
    assert (turn < 0.0).all() if around.clockwise else (turn > 0.0).all()


def test_a_ball_is_held_passes_its_target_and_comes_to_rest() -> None:
    ball = Thrown.at_target((4.0, 1.0, 1.2), (0.0, 0.0, 1.5), 0.8, 2.0)
    place, velocity = ball.at(np.array([0.0, 1.999, 2.8, 60.0]))
    np.testing.assert_allclose(place[[0, 1, 2]], [(4.0, 1.0, 1.2), (4.0, 1.0, 1.2), (0.0, 0.0, 1.5)], atol=1e-12)
    np.testing.assert_array_equal(velocity[[0, 1, 3]], 0.0)
    assert place[3, 2] == pytest.approx(ball.floor)
    assert Bodies([Body(0.1, ball), Body(0.1, Still((0.0, 0.0, 0.0)))]).falls.tolist() == [True, False]


def test_near_is_measured_along_the_whole_way() -> None:
    bodies = Bodies([Body(0.4, motion, upright=k % 2 == 0) for k, motion in enumerate(MOTIONS.values())])
    path, times = FigureEight(3.0).at(np.linspace(0.0, 2.0, 201)).position, np.linspace(0.0, 2.0, 201)
    found = bodies.nearest(path, times).min(axis=0)
    dense = np.linspace(0.0, 2.0, 40001)
    away = FigureEight(3.0).at(dense).position[:, None] - bodies.at(dense)[0]
    away[:, bodies.upright, 2] = 0.0
    np.testing.assert_allclose(found, (np.linalg.norm(away, axis=2) - 0.4).min(axis=0), atol=2e-3)


def test_what_passes_between_two_looks_is_not_missed() -> None:
    passing = Bodies([Body(0.05, Shuttle((0.0, -1.0, 0.0), (0.0, 1.0, 0.0), 100.0))])
    times = np.array([0.0, 0.02])  # from one end to the other
    near = passing.nearest(np.zeros((2, 3)), times)
    np.testing.assert_allclose(near, [[-0.05]], atol=1e-12)


def test_cylinders_have_no_end_and_spheres_do() -> None:
    two = Bodies([Body(0.5, Still((0.0, 0.0, 0.0)), upright=True), Body(0.5, Still((0.0, 0.0, 0.0)))])
    near = two.nearest(np.array([[1.0, 0.0, 9.0], [1.0, 0.0, 9.0]]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(near, [[0.5, np.sqrt(82.0) - 0.5]])
    assert Bodies([]).nearest(np.zeros((5, 3)), np.arange(5.0)).shape == (4, 0)
