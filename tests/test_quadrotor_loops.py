"""A quadrotor whose loops are part of its state: the defect of a step against the plant, and refusals."""

from __future__ import annotations

import numpy as np
import pytest

from unifg.errors import ModelError
from unifg.models import quadrotor, quadrotor_loops
from unifg.scenarios.simulation.body_rate import Airframe, BodyRatePlant, Loops
from unifg.typing import Array

HEAVY = quadrotor.Parameters(1.1, (0.3, 0.3, 0.15))
LOOPS = Loops(22.0, 0.03, 0.0)
BEGIN = np.array([0.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.5, -0.3, 0.2])
TOLD = np.array([-2.0, 1.0, 0.4, 14.0])


def flown(ticks: int, tick: float) -> tuple[Array, Array]:
    """(17,) before and after a command that acts at once, from the midst of a manoeuvre."""
    plant = BodyRatePlant(Airframe(HEAVY, LOOPS), BEGIN, tick)
    for _ in range(12):
        plant.tick([1.0, -0.5, 0.2, 11.0])
    plant.tick(TOLD)  # it arrives a tick later
    before = np.concatenate([plant.state, plant.loops])
    for _ in range(ticks):
        plant.tick(TOLD)
    return before, np.concatenate([plant.state, plant.loops])


def missed(before: Array, after: Array, h: float, gust: Array) -> Array:
    loops = quadrotor_loops.held(LOOPS.gain, LOOPS.lag, [h])
    given = np.array([[HEAVY.mass]]), np.array([HEAVY.drag]), gust[None]
    return np.asarray(quadrotor_loops.defect(before[None], TOLD[None], *given, after[None], np.array([h]), loops)[0])


@pytest.mark.parametrize("h", [0.01, 0.05])
@pytest.mark.product(1)
def test_the_loops_are_exact_and_the_pose_nearly(h: float) -> None:
    before, after = flown(1, h)
    wrong = missed(before, after, h, np.zeros(3))
    np.testing.assert_allclose(wrong[9:], 0.0, atol=1e-12)
    np.testing.assert_allclose(wrong[3:6], 0.0, atol=50.0 * h**3)
    np.testing.assert_allclose(wrong[6:9], 0.0, atol=60.0 * h**3)
    np.testing.assert_allclose(wrong[:3], 0.0, atol=10.0 * h**3)


def test_gusts_push() -> None:
    before, after = flown(1, 0.01)
    gust = np.array([0.3, -0.2, 0.1])
    moved = missed(before, after, 0.01, np.zeros(3)) - missed(before, after, 0.01, gust)
    np.testing.assert_allclose(moved, [0, 0, 0, 0, 0, 0, *(0.01 * gust), *np.zeros(7)], atol=1e-15)


def test_a_short_step_goes_where_the_field_points() -> None:
    before, _ = flown(1, 0.01)
    rng, h = np.random.default_rng(0), 1e-6
    given = np.array([[HEAVY.mass]]), np.array([HEAVY.drag]), rng.normal(size=(1, 3))
    rate = quadrotor_loops.field(before[None], TOLD[None], *given, LOOPS.gain, LOOPS.lag)
    after = quadrotor_loops.STATE.retract(before[None], h * rate)
    loops = quadrotor_loops.held(LOOPS.gain, LOOPS.lag, [h])
    wrong = quadrotor_loops.defect(before[None], TOLD[None], *given, after, np.array([h]), loops)
    np.testing.assert_allclose(wrong / h, 0.0, atol=2e-3)


def test_nothing_is_missed_by_loops_without_lag_nor_in_no_time() -> None:
    """Any other duration is held against exponentials of matrices in `test_safe_worlds`."""
    np.testing.assert_array_equal(quadrotor_loops.held(np.inf, 0.02, [0.01, 0.05]), 0.0)  # nothing is missed
    np.testing.assert_allclose(quadrotor_loops.held(25.0, 0.02, 0.0)[0], [1, 0, 0, 1, 1, 1, 0, 1], atol=1e-15)


@pytest.mark.parametrize(
    ("gain", "lag", "durations"),
    [(0.0, 0.02, 0.01), (-1.0, 0.02, 0.01), (25.0, 0.0, 0.01), (25.0, 0.02, [0.01, -0.01]), (np.nan, 0.02, 0.01),
     (25.0, 0.02, np.inf)],
)  # fmt: skip
def test_loops_that_are_none_are_refused(gain: float, lag: float, durations: float | list[float]) -> None:
    with pytest.raises(ModelError, match="above zero and finite"):
        quadrotor_loops.held(gain, lag, durations)
