"""A network that learns in flight what a quadrotor's model leaves out."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks import learned_residual as study


@pytest.mark.product(1, of="drives and flights")
@pytest.mark.parametrize("seed", [11, 12])
def test_a_network_learns_within_a_lap(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "LAPS", 1)
    rows = [{"seed": seed, "model": model, **study.measure(seed, model)} for model in study.MODELS]
    plain, learned = rows
    assert learned["lap 1"] < 0.8 * plain["lap 1"]
    assert learned["missing"] < 0.8 * plain["missing"]
    assert plain["solved"] == learned["solved"] == study.LAP
    table = study.tables(rows)
    assert f"{plain['lap 1']:.3g}" in table and "1 flights of 100 ticks" in table


def test_a_network_without_weights_in_its_second_layer_says_nothing() -> None:
    air, weights = np.ones((2, 3)), np.concatenate([np.ones(study.FIRST), np.zeros(study.SECOND)])[None]
    assert np.array_equal(study.network(air, weights), np.zeros((2, 3)))
