"""Sets in which a plan may end, and barriers in flight: hard plans stay possible, the guarded flight keeps clear."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.graphs import graph_of
from problems.guarded_flight import NAMES, SPHERES, START, GuardedFlight
from test_barriers import CENTRE, EXACT, INEQUALITIES, RADIUS, spheres
from unifg.errors import ModelError
from unifg.models import (
    avoidance,
    barriers,
    keeping,
    quadrotor,
    terminal,
)
from unifg.solvers import InteriorPoint
from unifg.typing import Array

POINT = fg.Rn(6)  # position and velocity, pushed by an acceleration


def advance(x: Array, u: Array, dt: float) -> Array:
    return np.concatenate([x[:, :3] + dt * x[:, 3:] + 0.5 * dt**2 * u, x[:, 3:] + dt * u], axis=1)


def closed_loop(
    end: str, seed: int, ticks: int = 35, alpha: float = 20.0, size: float = 2.0
) -> tuple[list[bool], Array]:
    """A double integrator that is sent through spheres by short plans; whether each solve had an answer."""
    rng = np.random.default_rng(seed)
    centre, radius = rng.uniform([1.0, -0.6, -0.6], [4.0, 0.6, 0.6], (3, 3)), rng.uniform(0.2, 0.5, 3)
    centre, radius = centre + np.array([3.0 * size - 3.0, 0.0, 0.0]), size * radius  # larger and further away
    dt, n, push = 0.1, 4, 3.0
    graph, x, u = graph_of(("x", POINT, n + 1), ("u", fg.Rn(3), n))
    start = graph.data("start", np.zeros(6))
    graph.fix(x[0], start)
    graph.constrain(lambda x, u, y: y - advance(x, u, dt), x[:-1], u, x[1:], lower=0.0, upper=0.0, name="motion")
    graph.bound(u, lower=-push, upper=push, name="push")
    graph.minimize(lambda x: x[:, :3] - [5.0, 0.0, 0.0], x[1:], sigma=0.1)
    graph.minimize(fg.prior, u, np.zeros(3), sigma=10.0)
    h = barriers.still(avoidance.sphere_clearance)
    of_state = barriers.decay(lambda x, t, *o: h(x[:, :3], t, *o), alpha)
    graph.constrain(of_state, x[:-1], x[1:], 0.0, dt, centre, radius, lower=0.0, name="barrier")
    if end == "rest":
        graph.constrain(lambda x: x[:, 3:], x[-1:], lower=0.0, upper=0.0, name="end")
    elif end == "brake":
        left = terminal.brakeable(h, alpha, push, p=slice(0, 3), v=slice(3, 6))
        graph.constrain(left, x[-1:], 0.0, centre, radius, lower=0.0, name="end")
    run = InteriorPoint(tolerance=1e-6).prepare(graph)
    state = np.zeros(6)
    plan = np.zeros((n + 1, 6)), np.zeros((n, 3))
    plan[0][:, 3] = 0.01
    held, states = [], [state]
    for _ in range(ticks):
        found = run.solve({x: plan[0], u: plan[1]}, data={start: state})
        held.append(found.violation < 1e-6)
        if not held[-1]:
            break
        plan = np.concatenate([found[x][1:], found[x][-1:]]), np.concatenate([found[u][1:], np.zeros((1, 3))])
        state = found[x][1]
        states.append(state)
    return held, np.linalg.norm(np.array(states)[:, None, :3] - centre, axis=2) - radius


@pytest.mark.parametrize("end", ["rest", "brake"])
@pytest.mark.parametrize("seed", range(6))
def test_a_terminal_set_keeps_hard_plans_possible(seed: int, end: str) -> None:
    held, away = closed_loop(end, seed)
    assert all(held) and away.min() > -1e-6, (end, seed, len(held))


def test_aligned_nodes_stay_where_they_are() -> None:
    for number in range(12):
        begins, lengths = keeping.aligned(3, 0.01, 0.05, number)
        np.testing.assert_allclose(begins + lengths, np.cumsum(lengths))
        ends = 0.01 * number + begins + lengths
        np.testing.assert_allclose(ends, 0.05 * (number // 5 + 1 + np.arange(3)), atol=1e-12)
        assert lengths[0] > 0.0 and (lengths[1:] == 0.05).all()
    for count, tick, node, number in ((0, 0.01, 0.05, 0), (3, 0.0, 0.05, 0), (3, 0.01, 0.05, -1), (3, 0.1, 0.05, 0)):
        with pytest.raises(ModelError, match="aligned nodes need"):
            keeping.aligned(count, tick, node, number)
    with pytest.raises(ModelError, match="no whole number of ticks"):
        keeping.aligned(3, 0.02, 0.05, 0)


def test_without_a_terminal_set_hard_plans_end() -> None:
    assert not any(all(closed_loop("", seed)[0]) for seed in range(3))


def test_the_sets_to_end_in_are_what_they_say() -> None:
    whole = quadrotor.STATE.identity()[None].copy()
    assert not terminal.resting(whole).any()
    whole[0, 3:7], whole[0, 7:] = fg.SO3.exp(np.array([0.3, 0.0, 0.0])), (1.0, 2.0, 3.0)
    np.testing.assert_allclose(terminal.resting(whole), [[1.0, 2.0, 3.0, 0.0, -np.sin(0.3)]], atol=1e-12)
    whole[0, 3:7], whole[0, 7:] = fg.SO3.exp(np.array([0.0, 0.0, 2.0])), 0.0  # hover faces anywhere
    np.testing.assert_allclose(terminal.resting(whole), np.zeros((1, 5)), atol=1e-12)


def test_braking_stays_in_the_set() -> None:
    """From random states in it, straight at the nearest obstacle: h and the set hold until it rests."""
    h = barriers.still(avoidance.sphere_clearance)
    alpha, a, dt = 1.7, 3.0, 4e-3
    left = terminal.brakeable(h, alpha, a, p=slice(0, 3), v=slice(3, 6))
    rng = np.random.default_rng(2)
    for _ in range(8):
        p = rng.normal(size=3) * 2.0
        away = spheres(p[None])[0]
        if away.min() <= 0.0:
            continue
        to = CENTRE[away.argmin()] - p
        v = to / np.linalg.norm(to) * min(alpha * away.min(), a / alpha)
        x = np.concatenate([p, v])[None]
        assert left(x, 0.0, CENTRE, RADIUS).min() > -1e-9
        while np.linalg.norm(x[0, 3:]) > a * dt:
            after = advance(x, -a * x[:, 3:] / np.linalg.norm(x[:, 3:]), dt)
            assert (
                barriers.decay(lambda x, t, *o: h(x[:, :3], t, *o), alpha)(x, after, 0.0, dt, CENTRE, RADIUS).min()
                > -1e-9
            )
            assert left(after, 0.0, CENTRE, RADIUS).min() > -1e-9
            x = after


# ---------------------------------------------------------------- in flight


@pytest.mark.parametrize("name", INEQUALITIES)
@pytest.mark.product(2)
def test_a_tick_of_the_guarded_flight(name: str) -> None:
    flight, solver = GuardedFlight("slack"), replace(INEQUALITIES[name], tolerance=1e-5)
    found = solver.solve(flight.graph, flight.guess(), check=True)
    assert judge(flight.graph, found).worst() < 1e-3
    routes = flight.graph.check(flight.guess()).routes
    assert routes["motion"] == routes["spheres"] == EXACT
    h = flight.clearance(found[flight.x])
    assert (h > 0.0).all()


def test_a_loop_of_ticks_keeps_clear() -> None:
    flight = GuardedFlight("slack")
    run = InteriorPoint().prepare(flight.graph)
    begin: Any = flight.guess()
    state = START.copy()
    for tick in range(60):
        begin = found = run.solve(begin, data=flight.data(state, tick * flight.tick))
        assert found.converged
        before = flight.clearance(state[None])[0]
        state = quadrotor.fly(state, found[flight.u][0], flight.tick, quadrotor.Parameters())
        assert flight.clearance(state[None])[0] > np.exp(-flight.alpha * flight.tick) * before - 1e-3
    assert flight.kept is not None and flight.kept.obstacles == NAMES and len(SPHERES) == len(NAMES)
