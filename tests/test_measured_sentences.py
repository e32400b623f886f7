"""Sentences on measured pages are computed from the results they stand beside."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from benchmarks import control_loops, coupling, obstacle_fields
from benchmarks.control_loops import Drive
from benchmarks.obstacle_fields import BACKENDS, METHODS, Outcome
from problems.control import Problem, Quadrotor, Unicycle


def test_obstacle_fields_count_what_they_say() -> None:
    good, deceived, short = (
        Outcome(True, True, True, 1.0, 5, 1.0), Outcome(True, False, True, 1.0, 5, 1.0),
        Outcome(False, True, False, 1.0, 5, 1.0),
    )  # fmt: skip
    results = {(m.name, b): [good, good, good] for m in METHODS for b in BACKENDS}
    results["potential", "sqp"] = [good, deceived, short]
    results["potential, vortex", "sqp"] = [short, good, short]
    said = obstacle_fields.sayings(results).splitlines()
    assert said[0] == "- **Hard clearance** passes 3 (alm) and 3 (sqp) of 3 fields and solves 3 (alm) and 3 (sqp)."
    assert "3 (alm) and 1 (sqp) passed. 0 (alm) and 1 (sqp) plans collide, of which 0 (alm) and 1 (sqp) pass" in said[1]
    (vortex,) = (line for line in said if line.startswith("- **Vortex.**"))
    assert "rescues 0 (alm) and 1 (sqp) fields and breaks 0 (alm) and 1 (sqp)" in vortex


def test_couplings_are_compared_seed_by_seed() -> None:
    def row(variant: str, seed: int, error: float, reached: bool = True) -> dict[str, Any]:
        metrics = {
            "localisation_error_m": {"mean": error, "max": error}, "localisation_error_rad": {"mean": 0.0},
            "collisions": 0, "duration_s": 1.0, "min_clearance_m": 0.1, "solve_ms": {"p50": 2.0, "p99": 4.0},
            "reached": reached,
        }  # fmt: skip
        job = {"case": "building", "solver": "sqp", "coupling": variant, "weight": 1.0, "seed": seed}
        return {**job, "metrics": metrics}

    rows = [row("sequential", seed, 0.01 + seed) for seed in range(4)]
    rows += [row("joint", seed, 0.012 + seed, seed > 0) for seed in range(4)]
    said = coupling.sayings(rows)
    assert "the joint graph localises +2 mm (+2 to +2, +2 at most)" in said
    assert "- 8 drives, 0 collisions, 1 goals missed" in said


def test_one_iteration_a_step_is_named_where_it_is_not_safe() -> None:
    planar, spatial = Unicycle("straight", True, 50), Quadrotor("goto", False, 20)

    def drive(milliseconds: float, cost: float, depth: float = -np.inf) -> Drive:
        return Drive(times=[milliseconds] * 3, iterations=[1] * 3, cost=cost, penetration=depth)

    results: dict[Problem, dict[str, Drive]] = {
        planar: {
            "ipopt": drive(2.0, 10.0), "ipm": drive(1.0, 10.0), "ipm, 1 iteration": drive(0.1, 10.5, 2e-3),
            "sqp, 1 iteration": drive(0.4, 10.001, -1e-5), "ipm, safe": drive(0.2, 10.0, 3e-3),
        },
        spatial: {
            "ipopt": drive(1.0, 7.0), "ipm": drive(1.0, 7.0), "ipm, 1 iteration": drive(0.088, 7.0),
            "sqp, 1 iteration": drive(0.4, 7.0), "ipm, safe": drive(0.1, 7.0),
        },
    }  # fmt: skip
    text = control_loops.render_single(results)
    assert "at most 0.5 times as long on the unicycle and 2.0 times as long on the quadrotor" in text
    named = text.splitlines()[-1].partition("in an obstacle: ")[2]
    single, _, safe = named.partition(" The same of loops")
    assert single == "`ipm, 1 iteration` in unicycle straight, discs, N = 50 (+5.0 % cost, 2 mm deep in an obstacle)."
    assert safe.endswith("`ipm, safe` in unicycle straight, discs, N = 50 (+0.0 % cost, 3 mm deep in an obstacle).")


def test_claims_survive_the_file_and_are_counted() -> None:
    pytest.importorskip("casadi", reason="the judge differentiates with casadi, which comes with the extra 'bench'")
    from benchmarks import claims
    from exact_judge import Answer, Peer

    peer = Peer("Solve_Succeeded", True, 9, 1.0, 0.0, 1.0)
    answers = {
        "sqp": Answer("CONVERGED", 5, 0.1, 1.0, 1e-7, 0.0, 0.0, "true"),
        "ipm": Answer("CONVERGED", 5, 0.1, 0.5, 3e-3, 0.0, 0.0, "false", "stationarity is 0.003"),
        "alm": Answer("LOCALLY_INFEASIBLE", 5, 0.1, 2.0, 1.0, 0.1, 0.0, "saddle"),
    }
    case = claims.Case("parking", 3, False, answers, peer, None)
    assert claims.restored(json.loads(json.dumps({"code": "now", **asdict(case)}))) == case
    text = claims.render([case])
    assert "- parking 3, ipm: `CONVERGED`, but stationarity is 0.003." in text
    assert "| alm | 0 / 1 | 0 | - | 0 / 1 / 0 | 1 | 0 |" in text
    assert "| ipm | 1 / 1 | 1 | 3.00e-03 | 0 / 0 / 0 | 0 | 0 | 1 / 0 / 0 |" in text
