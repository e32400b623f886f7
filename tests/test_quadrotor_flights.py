"""The campaign of flights: what is flown, that it can go on where it stopped, and what its tables say."""

from __future__ import annotations

import copy
import json
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from benchmarks import quadrotor_tables
from benchmarks.comparison import against, paired, share
from benchmarks.quadrotor_flights import STUDIES, cells
from unifg.scenarios.episode import silent
from unifg.scenarios.flight import Flight, FlightSettings, run_flight
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.scenarios.papers import corridor_flights
from unifg.scenarios.papers.corridor_flights import Job
from unifg.scenarios.simulation.faults import FLIGHT_FAULTS, one_of

Row = dict[str, Any]


@pytest.fixture(scope="module")
def short_rows() -> dict[str, Row]:
    """A row of each coupling, of flights that last a moment; through JSON, as they are stored."""
    rows = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(corridor_flights, "run_flight", moment)
        for coupling in quadrotor_tables.VARIANTS:
            job = Job("flights", "ipm", coupling, 1006)
            row = {**asdict(job), **corridor_flights.fly(**asdict(job))}
            rows[coupling] = json.loads(json.dumps(row, allow_nan=False))
    return rows


def moment(settings: FlightSettings) -> FlightLog:
    """Fly a little longer than the first time at which the mass is looked at."""
    return run_flight(replace(settings, time_limit=1.1))


def test_every_study_flies_what_it_should() -> None:
    jobs = [Job(**cell) for cell in cells(range(100))]
    count = {study: sum(job.study == study for job in jobs) for study in STUDIES}
    assert count == {
        "flights": 7 * 100, "potential": 3 * 100, "association": 100, "movers": 100,
        "timing": 20 * 2 * (3 + 1 + 1),
    }  # fmt: skip
    assert len(set(jobs)) == len(jobs)
    assert next(job for job in jobs if job.study == "potential").settings().controller.avoidance == "potential"
    assert next(job for job in jobs if job.study == "association").settings().estimator.association == "unknown"
    assert next(job for job in jobs if job.study == "movers").settings().movers == 2


def test_the_truth_of_a_loaded_vehicle_has_its_load() -> None:
    """Errors and coverage of the mass were those against the empty vehicle."""
    fault = one_of(FLIGHT_FAULTS)("payload=0.25@0.2")
    log = Flight(FlightSettings(seed=1, time_limit=0.6, faults=(fault,)), rehearsal=True).run(silent)
    empty = log.parameters_true[0, 0]
    assert log.parameters_true.shape == (log.ticks, 7)
    np.testing.assert_allclose(log.parameters_true[:, 0], empty * np.where(log.time > 0.2 + 1e-9, 1.25, 1.0))
    error = flight_metrics(log)["mass_error_relative"]
    assert error == pytest.approx(abs(log.parameters[-1, 0] / (1.25 * empty) - 1.0))


@pytest.mark.product(2, of="drives and flights")
def test_rows_have_what_tables_need(short_rows: dict[str, Row]) -> None:
    text = quadrotor_tables.render(list(short_rows.values()))
    assert "1 seeds" in text
    assert "0 of 1" in text
    assert "m from the target after 1.1 s" in text
    assert "| ipm | sequential | 1 | 1 |" in text
    assert "nan" not in text
    for block in text.split("\n\n"):
        lines = [line for line in block.splitlines() if line.startswith("|")]
        assert len({line.count("|") for line in lines}) <= 1


@pytest.mark.product(2, of="drives and flights")
def test_a_failure_is_told(short_rows: dict[str, Row]) -> None:
    row = copy.deepcopy(short_rows["sequential"])
    row["metrics"] |= {"collisions": 1, "reached": True}
    row["contact"] = {"time_s": 3.2, "place": [4.0, -1.0, 1.5], "position_error_m": 0.02, "emergency_before": 4}
    assert "touched at 3.2 s, (4.0, -1.0, 1.5); belief off by 2 cm, 4 of 20 ticks" in quadrotor_tables.failures([row])
    row["metrics"]["succeeded"] = True
    assert quadrotor_tables.failures([row]) == ""


@pytest.mark.product(2, of="drives and flights")
def test_differences_are_paired(short_rows: dict[str, Row]) -> None:
    def variant(seed: int, value: float | None) -> Row:
        row = {**copy.deepcopy(short_rows["joint"]), "seed": seed}
        row["metrics"]["time_to_goal_s"] = value
        return row

    read = quadrotor_tables.MEASURES["time to goal [s]"]
    mine = [variant(0, 3.0), variant(1, 4.0), variant(2, None), variant(4, 9.0)]
    base = [variant(3, 7.0), variant(1, 5.0), variant(0, 1.0), variant(2, 6.0)]
    np.testing.assert_array_equal(paired(mine, base, read), ([3.0, 4.0], [1.0, 5.0]))
    assert against(mine, base, read) == "3.5 (-1 .. +2), n=2"
    assert against(base, base, read) == "4.75"
    assert against(mine[2:3], base, read) == "-"


def test_the_worst_run_counts() -> None:
    def row(run: int, milliseconds: float, ticks: int) -> Row:
        times = {"estimate_ms": [milliseconds] * ticks, "plan_ms": [1.0] * ticks}
        return {"study": "timing", "solver": "ipm", "coupling": "joint", "run": run, "metrics": {}, **times}

    rows = [row(0, 4.0, 3000), row(0, 6.0, 2500), row(1, 9.0, 5000)]
    assert "| ipm | joint | 2 | 5000 | 10.0 | 10.0 | 10.0 | 9.0 / 9.0 | 1.0 / 1.0 |" in quadrotor_tables.ticks(rows)


@pytest.mark.parametrize(("good", "count"), [(95, 100), (5, 5), (0, 7), (1, 2), (81, 263)])
def test_wilson_intervals(good: int, count: int) -> None:
    wanted = stats.binomtest(good, count).proportion_ci(0.95, "wilson")
    assert share(good, count) == pytest.approx((wanted.low, wanted.high), abs=1e-4)
