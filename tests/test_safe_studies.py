"""Studies of flights that keep their distance: what noise leaves of a linear loop, alphas at equal distance, pairs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks import flight_floor, horizon_and_velocity
from benchmarks.flight_floor import Axis, chain, cheapest, left, plan, regulator
from benchmarks.horizon_and_velocity import Flown
from unifg.scenarios.safe_flight import SafeSettings
from unifg.scenarios.safety.cbf_mpc import TRACKING

BOOKS = SafeSettings().books.loops


@pytest.mark.parametrize("axis", ["level", "up"])
def test_what_is_left_is_what_a_long_simulation_leaves(axis: Axis) -> None:
    """The same filter and feedback, with noise that is drawn."""
    feedback = regulator(axis, 1e-7)
    step, told, noise, seen, blur = chain(axis, BOOKS)
    n, rng, count = len(told), np.random.default_rng(0), 20_000
    spread = np.diag(np.full(n, 1e-4))
    for _ in range(3000):
        gain = spread @ seen.T @ np.linalg.inv(seen @ spread @ seen.T + blur)
        spread = step @ (spread - gain @ seen @ spread) @ step.T + noise
    root = np.linalg.cholesky(noise + 1e-18 * np.eye(n))
    shaken, blurred = rng.normal(size=(count, n)) @ root.T, rng.normal(size=(count, len(seen))) @ np.sqrt(blur)
    state, believed, pending = np.zeros(n), np.zeros(n), [0.0, 0.0]  # of two ticks ago, of the last
    squares = 0.0
    for k in range(count):
        believed = believed + gain @ (seen @ state + blurred[k] - seen @ believed)
        command = -float(feedback[0] @ believed) - feedback[1] * pending[1] - feedback[2] * pending[0]
        state, believed = step @ state + told * pending[0] + shaken[k], step @ believed + told * pending[0]
        pending = [pending[1], command]
        squares += state[0] ** 2
    assert left(axis, feedback, BOOKS)[0] == pytest.approx(np.sqrt(squares / count), rel=0.08)


def test_nobody_gets_below_the_regulator_at_the_same_effort() -> None:
    weights = {name: getattr(TRACKING, name) for name in ("position", *flight_floor.NAMES)}
    for feedbacks in (plan(weights), plan({**weights, "attitude": 1e-9, "velocity": 0.8, "rate": 2.6e-6})):
        for axis, feedback in feedbacks.items():
            distance, effort = left(axis, feedback, BOOKS)
            least = left(axis, cheapest(axis, effort), BOOKS)
            assert least[1] == pytest.approx(effort, rel=1e-2) and least[0] <= distance


def test_commands_that_come_late_cost_something() -> None:
    weights = {name: getattr(TRACKING, name) for name in ("position", *flight_floor.NAMES)}
    level, truth = plan(weights)["level"], SafeSettings().true_loops
    there, here = left("level", level, truth)[0], left("level", level, BOOKS)[0]
    assert here < there < 1.5 * here
    looks, air = left("level", level, truth, air=0.0)[0], left("level", level, truth, sights=0.0)[0]
    assert there**2 == pytest.approx(looks**2 + air**2, rel=1e-6)


def test_alpha_is_found_between_two_that_were_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    def flown(seed: int, gamma: float, alpha: float) -> Flown:
        return Flown(1.0 + gamma - 0.3 * float(np.log(alpha)), 0.0, 0.0, True)

    monkeypatch.setattr(horizon_and_velocity, "past_the_sphere", flown)
    wanted = [horizon_and_velocity.alpha_for(gamma, 1.0, [1, 2], 5) for gamma in (0.0, 0.2)]
    np.testing.assert_allclose(wanted, np.exp([0.0, 0.2 / 0.3]), rtol=1e-9)


def test_flights_are_compared_seed_by_seed() -> None:
    def some(*errors: float) -> list[Flown]:
        return [Flown(error, 0.0, 0.0, True) for error in errors]

    one: Any = some(0.1, 0.5, 0.9)
    assert horizon_and_velocity.paired(one, one, "error") == "-"
    assert horizon_and_velocity.paired(some(0.102, 0.502, 0.902), one, "error") == "+2 (+2 .. +2)"
