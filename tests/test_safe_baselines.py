"""Those whom barriers in a plan are compared with, and the oracle that judges all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from unifg.errors import ScenarioError
from unifg.scenarios.planning.flat_path import Line
from unifg.scenarios.quadrotor.cbf_mpc import Obstacles
from unifg.scenarios.quadrotor.one_step import FilterSettings, filtered
from unifg.scenarios.quadrotor.oracle import Authority, Threat, escape, exists
from unifg.scenarios.quadrotor.spline_planner import SplineSettings, around
from unifg.scenarios.safe_flight import SafeSettings, flights

LINE = Line((-4.0, 0.0, 1.5), (4.0, 0.0, 1.5), 2.0, 1.5)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def one(
    place: tuple[float, float, float], *, upright: bool = True, falls: bool = False, speed: float = 0.0
) -> Obstacles:
    """An obstacle 0.75 m away from whose centre nobody may be, moving along x."""
    return Obstacles(
        np.array([place]), np.array([[speed, 0.0, 0.0]]), np.array([0.75]), np.array([upright]), np.array([falls])
    )


def state(x: float, y: float, vx: float, vy: float = 0.0) -> np.ndarray:
    return np.concatenate([[x, y, 1.5], LEVEL, [vx, vy, 0.0]])


# ---------------------------------------------------------------- one step


def test_far_away_nothing_is_filtered() -> None:
    wanted = np.array([1.0, -2.0, 0.5])
    found, slack = filtered(wanted, state(-9.0, 0.0, 0.5), one((0.0, 0.0, 0.0)), 0.0, FilterSettings())
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert slack < 1e-6


@pytest.mark.parametrize(("upright", "falls", "speed"), [(True, False, 0.0), (False, False, -0.5), (False, True, 0.0)])
def test_what_is_filtered_keeps_the_condition(upright: bool, falls: bool, speed: float) -> None:
    s, later = FilterSettings(), 0.07
    seen, now = (
        one((0.0, 0.1, 0.0 if upright else 1.4), upright=upright, falls=falls, speed=speed),
        state(-1.1, 0.0, 0.6),
    )
    found, slack = filtered(np.array([3.0, 0.0, 0.0]), now, seen, later, s)
    assert slack < 1e-3 and found[0] < 2.9

    def clearance(t: float) -> float:
        """Of the vehicle under that acceleration, t seconds after it begins."""
        place = now[:3] + now[7:] * t + 0.5 * found * t * t
        away = place - seen.at(np.array([later + t]))[0, 0]
        return float(np.linalg.norm(away[:2] if upright else away)) - 0.75

    h = 1e-4
    rate = (clearance(h) - clearance(-h)) / (2.0 * h)
    bend = (clearance(h) - 2.0 * clearance(0.0) + clearance(-h)) / h**2
    assert bend + (s.alpha + s.beta) * rate + s.alpha * s.beta * clearance(0.0) == pytest.approx(0.0, abs=2e-3)


def test_where_nothing_helps_the_slack_says_so_and_the_box_is_kept() -> None:
    s = FilterSettings()
    found, slack = filtered(np.zeros(3), state(-0.8, 0.0, 4.0), one((0.0, 0.0, 0.0)), 0.0, s)
    assert slack > 1.0
    assert found[0] == pytest.approx(-s.level, abs=1e-4) and np.abs(found).max() < s.level + 1e-6
    inside, _ = filtered(np.zeros(3), state(0.0, 0.0, 0.0), one((0.0, 0.0, 0.0)), 0.0, s)
    assert np.isfinite(inside).all()


# ---------------------------------------------------------------- splines


def test_without_obstacles_a_spline_stays_near_its_line() -> None:
    nothing = Obstacles(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0, bool), np.zeros(0, bool))
    times = np.linspace(-1.0, LINE.duration + 2.0, 200)
    flown, wanted = around(LINE, nothing, SplineSettings()).at(times), LINE.at(times)
    np.testing.assert_allclose(flown.position, wanted.position, atol=0.02)
    np.testing.assert_array_equal(flown.velocity[times < 0.0], 0.0)
    h = 1e-5
    inner = times[(times > 0.1) & (times < LINE.duration)]
    path = around(LINE, nothing, SplineSettings())
    slope = (path.at(inner + h).position - path.at(inner - h).position) / (2.0 * h)
    np.testing.assert_allclose(slope, path.at(inner).velocity, atol=1e-5)


@pytest.mark.parametrize("beside", [-0.3, 0.02])
def test_splines_leave_obstacles_on_the_nearer_side_and_a_margin_moves_them_away(beside: float) -> None:
    near = []
    for margin in (0.1, 0.4):
        path = around(LINE, one((0.0, beside, 0.0)), SplineSettings(margin=margin))
        places = path.at(np.linspace(0.0, path.duration, 2000)).position
        near.append(np.hypot(places[:, 0], places[:, 1] - beside).min() - 0.75)
        farthest = places[np.argmax(np.abs(places[:, 1])), 1]
        assert np.sign(farthest) == -np.sign(beside)
        np.testing.assert_allclose(places[[0, -1]], [LINE.start, LINE.end], atol=0.02)
    assert near[0] > -0.05 and near[1] > near[0] + 0.15


def test_splines_are_for_things_at_rest() -> None:
    with pytest.raises(ScenarioError, match="past things at rest, not in the case 'ellipse'"):
        flights(SafeSettings(case="ellipse", controller=("spline",)))


@pytest.mark.parametrize("controller", ["filter", "spline"])
@pytest.mark.product(1)
def test_baselines_pass_the_cylinder(controller: str) -> None:
    (flight,) = flights(SafeSettings(alpha=(3.0,), controller=(controller,)))  # type: ignore[arg-type]
    flight.situation = replace(flight.situation, duration=3.2)
    log = flight.run()
    assert not log.touched and log.clearance.min() < 0.5


# ---------------------------------------------------------------- the oracle


def test_the_oracle_is_right_about_a_vehicle_that_flies_straight_at_a_pillar() -> None:
    """Sideways it is half A (t - d)^2 away after t = distance / speed."""
    authority = Authority(vehicle=4.0, mass_error=0.0, delay=0.1)
    pillar = Threat(np.array([-2.0, 0.0, 0.0]), np.array([4.0, 0.0, 0.0]), 0.3, upright=True)
    certain, best = escape([pillar], authority)
    assert 0.5 * 4.0 * 0.4**2 - pillar.keep == pytest.approx(best, abs=2e-3)
    assert -1e-3 < certain <= best + 1e-9
    assert [exists([replace(pillar, keep=keep)], authority) for keep in (0.25, 0.33)] == ["yes", "no"]


def test_what_is_known_of_an_obstacle_is_no_threat() -> None:
    """A ball that will fall short of the vehicle, seen while it still rises towards it."""
    authority = Authority(vehicle=0.1, horizon=0.6)
    ball = Threat(np.array([-1.0, 0.0, 0.5]), np.array([2.0, 0.0, -1.0]), 0.3)
    falling = escape([replace(ball, pull=np.array([0.0, 0.0, -9.81]))], authority)
    assert escape([ball], authority)[1] < 0.0 < falling[0]
    later = np.linspace(0.0, 0.6, 301)[:, None]
    way = ball.away + ball.speed * later + 0.5 * 9.81 * later**2 * [0.0, 0.0, 1.0]
    assert falling[0] == pytest.approx(np.linalg.norm(way, axis=1).min() - 0.3, abs=0.02)


@pytest.mark.product(2, of="drives and flights")
def test_more_to_give_never_makes_it_worse() -> None:
    rng, base = np.random.default_rng(5), Authority()
    answers = []
    for _ in range(60):
        threat = Threat(rng.uniform(-2.0, 2.0, 3), rng.uniform(-5.0, 5.0, 3), rng.uniform(0.2, 0.8), bend=1.0)
        certain, best = escape([threat], base)
        assert certain <= best + 1e-9
        answers.append(exists([threat], base))
        changes = (replace(base, vehicle=3.0), replace(base, mass_error=0.5), replace(base, delay=0.4))
        weaker = [(threat, less) for less in changes] + [(replace(threat, bend=3.0), base)]
        for worse, less in weaker:
            assert (np.array(escape([worse], less)) <= np.array([certain, best]) + 1e-9).all()
    assert {"yes", "no"} <= set(answers)


def test_where_the_oracle_says_yes_an_acceleration_that_is_held_escapes_whatever_the_obstacle_does() -> None:
    rng, authority, bend = np.random.default_rng(6), Authority(horizon=1.5), 1.5
    times = np.linspace(0.0, 1.5, 301)
    angle = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    ways = authority.usable * np.column_stack([np.cos(angle), np.sin(angle)])
    late = 0.5 * np.maximum(times - authority.delay, 0.0) ** 2
    seen = 0
    for _ in range(40):
        away, speed = np.append(rng.uniform(-2.0, 2.0, 2), 0.0), np.append(rng.uniform(-3.0, 3.0, 2), 0.0)
        if exists([Threat(away, speed, 0.4, upright=True, bend=bend)], authority) != "yes":
            continue
        seen += 1
        worst = np.full(72, np.inf)
        for turn in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False):  # pushes of the obstacle, each held
            push = bend * np.array([np.cos(turn), np.sin(turn)])
            place = (away + times[:, None] * speed)[:, :2] - 0.5 * push * times[:, None] ** 2
            place = place + ways[:, None, :] * late[:, None]
            worst = np.minimum(worst, np.linalg.norm(place, axis=2).min(axis=1))
        assert worst.max() >= 0.4 - 1e-9
    assert seen > 5


def test_one_way_out_has_to_serve_against_all() -> None:
    authority, still = Authority(delay=0.1), np.zeros(3)
    coming = Threat(np.array([3.0, 0.0, 0.1]), np.array([-6.0, 0.0, 0.0]), 0.4)
    level = [Threat(np.array([0.0, side, 0.0]), still, 0.25, upright=True) for side in (-0.3, 0.3)]
    lid, floor = (Threat(np.array([0.0, 0.0, height]), still, 0.25) for height in (-0.3, 0.3))
    late = Threat(np.array([0.5, 0.0, 0.0]), np.array([-5.0, 0.0, 0.0]), 0.4)
    falling = Threat(np.array([0.0, 0.0, 0.6]), np.array([0.0, 0.0, 3.0]), 0.4, pull=np.array([0.0, 0.0, -9.81]))
    answers = {
        "nothing": ([], "yes"), "one": ([coming], "yes"), "upwards, between pillars": ([coming, *level], "yes"),
        "each by itself could be escaped": ([coming, *level, lid, floor], "unknown"), "late": ([late, *level], "no"),
        "gone": ([replace(late, until=0.01)], "yes"), "falling": ([falling], "yes"),
        "bent": ([replace(coming, bend=20.0)], "unknown"),
    }  # fmt: skip
    assert {name: exists(threats, authority) for name, (threats, _) in answers.items()} == {
        name: expected for name, (_, expected) in answers.items()
    }
