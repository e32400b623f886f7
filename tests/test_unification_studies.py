"""Counts of the studies of unification, and a test that each study still measures."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks import (
    active_perception,
    covariance_plans,
    excluded_pasts,
    impossible_states,
    learned_residual,
    many_landmarks,
    shared_dynamics,
)
from unifg.scenarios.episode import silent


def row(way: str, seed: int, found: list[tuple[float, float] | None]) -> dict[str, object]:
    """A row of the campaign with (time, collisions) of each setting."""
    numbers = {"clearance": 0.1, "sigma": 0.1}
    plans = [
        {"setting": setting, "seconds": 0.1, **({} if f is None else {"time": f[0], "collisions": f[1], **numbers})}
        for setting, f in zip(covariance_plans.WAYS[way], found, strict=True)
    ]
    return {"way": way, "seed": seed, "plans": plans}


def test_settings_are_compared_at_equal_risk(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(covariance_plans, "WAYS", {"margin": (0.1, 0.5), "in the graph": (1.0, 3.0)})
    rows = [
        row("margin", 0, [(10.0, 0.2), (12.0, 0.01)]), row("margin", 1, [(10.0, 0.04), None]),
        row("in the graph", 0, [(10.5, 0.01), (11.5, 0.0)]), row("in the graph", 1, [(10.2, 0.03), (11.0, 0.0)]),
        row("in the graph", 2, [None, None]),
    ]  # fmt: skip
    plans = covariance_plans.plans_of(rows)
    assert plans.index.unique("seed").tolist() == [0, 1]
    assert covariance_plans.chosen(plans, 0.05) == {"margin": 0.5, "in the graph": 1.0}
    assert covariance_plans.chosen(plans, 0.001) == {"in the graph": 3.0}
    best = covariance_plans.hindsight(plans, 0.02)
    assert best["margin"].to_dict() == {0: 12.0} and best["in the graph"].to_dict() == {0: 10.5, 1: 11.0}
    text = covariance_plans.render(rows)
    assert "| margin 0.5 m | 1 / 2 |" in text and "| 2% | in the graph | 2 / 2 | -1.5 (-1.5 .. -1.5), n=1 |" in text


def test_orchards_leave_a_way() -> None:
    for seed in range(2):
        world = excluded_pasts.orchard(seed)
        assert excluded_pasts.gaps(world.path, world.pillars).min() > 0.0
    through = excluded_pasts.gaps(np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), np.array([[1.0, 0.0]]))
    assert through.min() == pytest.approx(-excluded_pasts.PILLAR - excluded_pasts.ROBOT)  # also between the poses


def test_bodies_exclude_a_wrong_association() -> None:
    """A drive whose sightings are explained best by a path through a pillar."""
    world, (chance, clutter) = excluded_pasts.orchard(5), excluded_pasts.CONDITIONS["half are missed, clutter"]
    scans = excluded_pasts.scanned(world, chance, clutter, 5011)
    found = excluded_pasts.explained(world, scans, chance, clutter)
    error = {name: float(np.hypot(*(path - world.path)[-1, :2])) for name, path in found.items()}
    assert error["sightings alone"] > 1.0
    assert error["checked afterwards"] < 0.2 and error["in the graph"] < 0.2
    through, kept = (excluded_pasts.gaps(found[name], world.pillars) for name in ("sightings alone", "in the graph"))
    assert through.min() < -0.2 and kept[: excluded_pasts.STEPS + 1].min() > -2e-3


def test_a_pillar_is_seen_once_in_a_scan() -> None:
    """Two sightings near one pillar: the nearer one is its, and the other one clutter."""
    world = excluded_pasts.Orchard(np.array([[1.0, 0.0]]), np.zeros((excluded_pasts.STEPS + 1, 3)))
    sightings = np.array([[1.2, 0.0], [1.1, 0.0], [0.2, 1.0], [1.1, 0.0]])
    still = np.zeros((excluded_pasts.STEPS, 3))
    scans = excluded_pasts.Scans(sightings, np.array([0, 0, 0, 4]), still, np.zeros(3))
    estimator = excluded_pasts.Estimator(world, scans, 0.5, 1.0)
    _, matched, worth = estimator._associated(world.path)
    np.testing.assert_array_equal(matched, [False, True, False, True])
    assert worth == pytest.approx(2 * estimator._match + 2 * estimator._miss)  # due in four scans, seen in two


def test_what_cannot_have_been_helps() -> None:
    wall, drag = impossible_states.along_a_wall(0, 12), impossible_states.rolling(0, 12)
    rms = [float(np.sqrt(np.mean(np.square(errors)))) for errors in (*wall.values(), *drag.values())]
    assert rms[1] < rms[0] and rms[2] < 0.5 * rms[0] and rms[4] < rms[3]


def test_errors_are_compared_layout_by_layout() -> None:
    base, mine = [[0.1, 0.5], [0.3, 0.3]], [[0.1, 0.1], [0.3, 0.5]]
    assert excluded_pasts.compared(base, base, "wrong") == "25"
    assert excluded_pasts.compared(mine, base, "wrong") == "25 (-50 .. +50)"
    assert excluded_pasts.compared(mine, base, "median").startswith("25 (-20")


def test_ways_are_compared_at_equal_error_and_at_equal_time() -> None:
    def met(way: str, seed: int, *plans: tuple[str, float, float]) -> dict[str, object]:
        numbers = {"foreseen": 0.1, "miss": 0.2, "collisions": 0.0}
        found = [{"setting": s, "time": time, "error": error, **numbers} for s, time, error in plans]
        return {"way": way, "seed": seed, "plans": found}

    rows = [
        met("rule", 1, ("2", 10.0, 0.8), ("2", 10.5, 0.6), ("0.6", 12.0, 0.3)), met("rule", 2, ("2", 11.0, 0.9)),
        met("in the cost", 1, ("3", 10.2, 0.6), ("10", 11.0, 0.3)), met("in the cost", 2, ("3", 10.0, 0.8)),
        met("cautious", 1, ("3", 20.0, 0.9)), met("cautious", 2, ("3", 20.0, 0.9)), met("cautious", 3, ("3", 1.0, 0.0)),
    ]  # fmt: skip
    plans = covariance_plans.plans_of(rows)
    assert plans.index.unique("seed").tolist() == [1, 2]
    fastest = active_perception.fastest(plans, 0.35)
    assert fastest["rule"].to_dict() == {1: 12.0} and fastest["in the cost"].to_dict() == {1: 11.0}
    assert active_perception.surest(plans, 0.3)["rule"].to_dict() == {1: 0.8}  # 10.0 is the fastest of any way
    text = active_perception.render(rows)
    assert "| rule, 2 m | 10.5 (10 .. 11) | 85 (80 .. 90) |" in text  # the fastest with that setting
    assert "| 35 cm | 1 / 2 | 1 / 2 | 0 / 2 | -1 (-1 .. -1), n=1 | - |" in text


@pytest.mark.parametrize("past", ["nominal", "unknown"])
@pytest.mark.parametrize("plan", ["nominal", "estimated"])
def test_past_and_plan_are_chosen_apart(past: str, plan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the flight itself goes: a study whose pilot the flight passed by compared equal plans for days."""
    monkeypatch.setattr(shared_dynamics, "FLIGHT", 0.3)
    flight = shared_dynamics.prepared(1000, past, plan, accelerometer=plan == "nominal")
    flight.run(silent)
    pilot, nominal = cast(Any, flight.pilot), flight.conditions.nominal
    own, told = pilot.estimator.own, pilot.controller.belief
    assert own.estimated == (("mass", "drag", "wind") if past == "unknown" else ())
    assert (own.noise_sigma[5] > 1.0) == (past == "nominal")
    assert own.force_sigma == (shared_dynamics.FORCE_SIGMA if plan == "nominal" else None)
    np.testing.assert_array_equal(told.state, pilot.alone.state)
    assert (told.parameters == nominal) == (plan == "nominal")
    if plan == "estimated":
        assert pilot.adviser.own.estimated == ("mass", "drag", "wind")
        np.testing.assert_array_equal(told.parameters.packed[:1], pilot.adviser.parameters[:1])
        assert (pilot.adviser is pilot.estimator) == (past == "unknown")


def test_changes_are_compared_corridor_by_corridor() -> None:
    rows = [
        {
            "seed": seed, "past": past, "plan": plan, "accelerometer": False, "reached": True, "collisions": seed,
            "velocity": 100.0 + seed - (30.0 + seed) * (past == "unknown"), "position": 30.0, "clearance": 25.0,
            "tracking": 50.0 - 20.0 * (plan == "estimated"), "time": 15.0,
        }
        for seed in (0, 1) for past in ("nominal", "unknown") for plan in ("nominal", "estimated")
    ]  # fmt: skip
    text = shared_dynamics.render(rows)
    assert "| no | nominal | estimated | 100 | 30 | 30 | 25 | 15 | 1 of 2 |" in text
    assert "| no | unknowns in the dynamics of the past | estimated plan | -30 (-31 .. -30) | +0 (+0 .. +0) |" in text
    none = "+0 (+0 .. +0)"
    assert f"| no | estimates in the plan | past with unknowns | {none} | {none} | -20 (-20 .. -20) |" in text
    ahead, ticks = shared_dynamics.AHEAD, 30
    truth, plans = np.zeros((ticks, 10)), np.zeros((ticks, ahead + 1, 3))
    truth[:, 0] = 0.05 * np.arange(ticks)  # 1 m/s; planned to be 1.1, from where it was not
    plans[:, :, 0] = 7.0 + 0.055 * np.arange(ahead + 1)
    assert shared_dynamics.tracking(cast(Any, SimpleNamespace(truth=truth, plans=plans))) == pytest.approx(0.05)


@pytest.mark.product(1, of="drives and flights")
@pytest.mark.parametrize("seed", [11, 12])
def test_a_network_learns_within_a_lap(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(learned_residual, "LAPS", 1)
    rows = [
        {"seed": seed, "model": model, **learned_residual.measure(seed, model)} for model in learned_residual.MODELS
    ]
    plain, learned = rows
    assert learned["lap 1"] < 0.8 * plain["lap 1"]
    assert learned["missing"] < 0.8 * plain["missing"]
    assert plain["solved"] == learned["solved"] == learned_residual.LAP
    table = learned_residual.tables(rows)
    assert f"{plain['lap 1']:.3g}" in table and "1 flights of 100 ticks" in table


def test_a_network_without_weights_in_its_second_layer_says_nothing() -> None:
    air, weights = (
        np.ones((2, 3)),
        np.concatenate([np.ones(learned_residual.FIRST), np.zeros(learned_residual.SECOND)])[None],
    )
    assert np.array_equal(learned_residual.network(air, weights), np.zeros((2, 3)))


def test_plans_that_reuse_their_elimination_fly_as_those_solved_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(many_landmarks, "TICKS", 8)
    row = {"seed": 0, "count": 10, **many_landmarks.measure(0, 10)}
    anew, every, reuse = (many_landmarks.ANEW, *many_landmarks.THRESHOLDS)
    for name in (every, reuse):
        assert abs(row[f"{name}, off"] - row[f"{anew}, off"]) < 2e-3
        assert abs(row[f"{name}, clear"] - row[f"{anew}, clear"]) < 2e-3
    assert row[f"{reuse}, linearised"] < 0.2 * row[f"{every}, linearised"]
    assert row[f"{reuse}, eliminated"] < row[f"{every}, eliminated"]
    table = many_landmarks.tables([row])
    assert table.count(f"| {reuse} |") == len(many_landmarks.COUNTS) and "unknown map" in table
