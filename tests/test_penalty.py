"""The penalty baseline: its schedule, its estimates of the multipliers, and a status that does not flatter."""

from __future__ import annotations

import numpy as np
import pytest

import unifg as fg
from judge import judge
from problems.known import STARTS, active_bounds, ecg2o, ecg2o_inequality, inactive_inequality
from unifg.solvers import Penalty


@pytest.mark.parametrize("start", STARTS)
def test_case_study_2(start: tuple[float, float]) -> None:
    graph, guess = ecg2o(start)
    solution = Penalty().solve(graph, guess, check=True)
    assert judge(graph, solution).worst() < 2e-6
    assert solution.dual("curve")[0, 0] == pytest.approx(-1.0, abs=1e-5)
    # The minimum of a penalised cost violates: by about the multiplier over the weight.
    last = float(solution.history[-1].details["penalty"])
    assert solution.violation == pytest.approx(1.0 / last, rel=0.1)
    assert solution.cost < 1.0


def test_weights_follow_the_schedule() -> None:
    graph, guess = ecg2o((0.5, -0.5))
    solution = Penalty(penalty=2.0, penalty_growth=5.0).solve(graph, guess, check=True)
    weights = list(dict.fromkeys(float(row.details["penalty"]) for row in solution.history[1:]))
    np.testing.assert_allclose(weights, 2.0 * 5.0 ** np.arange(len(weights)))
    lighter = [row.violation for row in solution.history if row.details.get("penalty") == weights[2]][-1]
    heavier = [row.violation for row in solution.history if row.details.get("penalty") == weights[3]][-1]
    assert heavier == pytest.approx(lighter / 5.0, rel=0.2)


def test_inequalities_are_one_sided() -> None:
    graph, guess = inactive_inequality()
    inside = Penalty().solve(graph, guess, check=True)
    assert inside[graph.families["x"]][0, 0] == pytest.approx(0.2, abs=1e-9)
    assert inside.dual("limit")[0, 0] == 0.0
    graph, guess = active_bounds()
    box = Penalty().solve(graph, guess, check=True)
    np.testing.assert_allclose(box.dual("box"), [[2.0, -2.0, 0.0]], atol=1e-5)
    graph, guess = ecg2o_inequality()
    both = Penalty().solve(graph, guess, check=True)
    np.testing.assert_allclose(both[graph.families["x"]], [[5.0**-0.5, 2.0 * 5.0**-0.5]], atol=1e-5)


def test_a_light_last_weight_ends_without_the_claim() -> None:
    graph, guess = ecg2o((0.5, -0.5))
    solution = Penalty(largest_penalty=100.0).solve(graph, guess)
    assert solution.status is fg.Status.STOP_RULE
    assert not solution.converged
    assert solution.violation == pytest.approx(0.01, rel=0.1)
    assert solution.worst == ("curve", 0)
    assert solution.dual("curve")[0, 0] == pytest.approx(-1.0, abs=0.1)
