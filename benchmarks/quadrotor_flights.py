"""The campaigns behind docs/quadrotor-mpc.md: success, accuracy and times of flights through unknown corridors.

    python -m benchmarks.quadrotor_flights [--studies NAME ...] [--seeds 0:100] [--solvers NAME ...]
        [--couplings NAME ...] [--processes 2] [--fresh] [--report]

Every flight is a line of out/benchmarks/quadrotor_flights.jsonl and is not flown again until the code changes. The
study "timing" runs one flight at a time, whatever ``--processes`` says. All variants of a seed meet the same corridor,
mass, drag, wind, disturbances and sensor noise.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.campaign import campaign
from benchmarks.quadrotor_tables import HEADLINE, render
from benchmarks.report import CHECKOUT, OUT, code_digest, machine, put_results
from unifg.errors import UnifgError
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.flying.plan import Avoidance
from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import flight_metrics
from unifg.scenarios.worlds.layouts import CORRIDOR_SEEDS

Row = dict[str, Any]

STUDIES = ("flights", "potential", "association", "movers", "weights", "timing")
SOLVERS = ("ipm", "sqp", "alm")
COUPLINGS = ("separate", "sequential", "joint")
WEIGHTS = (0.1, 1.0, 10.0)
WEIGHT_SEEDS = 20
TIMED_FLIGHTS, TIMED_RUNS = 20, 3  # 20 flights are some 6000 ticks
MARKS = (1.0, 2.0, 5.0, 10.0)  # [s] at which the mass is looked at
TOUCH = 0.01  # [m]; a hull nearer than this has touched, or will


@dataclass(frozen=True)
class Job:
    """One flight and the conditions it is made under; what differs makes the key."""

    study: str
    solver: str
    coupling: str
    seed: int
    avoidance: Avoidance = "clearance"
    association: str = "known"
    movers: int = 0
    weight: float = 1.0
    run: int = 0
    code: str = ""

    @property
    def key(self) -> tuple[Any, ...]:
        """What makes two flights the same."""
        return tuple(asdict(self).values())

    def settings(self) -> FlightSettings:
        """The flight."""
        plain = FlightSettings(self.solver, self.coupling, self.seed, self.movers)
        return replace(
            plain,
            estimator=replace(plain.estimator, association=self.association),
            controller=replace(plain.controller, avoidance=self.avoidance, control_weight=self.weight),
        )


def jobs_of(
    studies: Sequence[str], solvers: Sequence[str], couplings: Sequence[str], seeds: Sequence[int], code: str
) -> list[Job]:
    """What there is to fly.

    Backends other than the headline's fly sequential and joint; potential costs, unknown association and movers are
    flown sequential.
    """
    jobs: list[Job] = []
    for study in studies:
        for solver in solvers:
            first = solver == HEADLINE
            pairs = [c for c in couplings if first or c != "separate"]
            if study == "flights":
                jobs += [Job(study, solver, c, seed, code=code) for seed in seeds for c in pairs]
            elif study == "potential" and "sequential" in couplings:
                jobs += [Job(study, solver, "sequential", seed, "potential", code=code) for seed in seeds]
            elif study == "association" and first:
                jobs += [Job(study, solver, "sequential", seed, association="unknown", code=code) for seed in seeds]
            elif study == "movers" and first:
                jobs += [Job(study, solver, "sequential", seed, movers=2, code=code) for seed in seeds]
            elif study == "weights" and first and "joint" in couplings:
                some = seeds[:WEIGHT_SEEDS]
                jobs += [Job(study, solver, "joint", seed, weight=w, code=code) for seed in some for w in WEIGHTS]
            elif study == "timing":
                some, timed = seeds[:TIMED_FLIGHTS], [c for c in pairs if c != "separate"]
                runs = range(TIMED_RUNS if first else 1)
                jobs += [Job(study, solver, c, s, run=r, code=code) for r in runs for c in timed for s in some]
    return jobs


def fly(job: Job) -> Row:
    """Fly once and keep what tables need; a refused flight is kept as an error."""
    row: Row = {"key": list(job.key), **asdict(job)}
    try:
        if job.study == "timing":
            run_flight(replace(job.settings(), time_limit=0.5))  # compiles what this process has not compiled yet
        log = run_flight(job.settings())
    except UnifgError as error:
        return {**row, "error": str(error)}
    metrics: Row = dict(flight_metrics(log))
    del metrics["settings"]
    ticks = {name: np.round(getattr(log, name), 3).tolist() for name in ("estimate_ms", "plan_ms")}
    return {**row, "metrics": metrics, "mass": _mass(log), "contact": _contact(log), **ticks}


def _mass(log: FlightLog) -> dict[str, list[float]]:
    """Relative error of the mass and its sigma at some times [s]."""
    marks = [round(mark / log.dt) for mark in MARKS]
    true = float(log.parameters_true[0])
    return {
        f"{log.dt * k:g}": [
            float(log.parameters[k, 0] / true - 1.0),
            float(log.parameters_sigma[k, 0] / true),
        ]
        for k in marks
        if k < log.ticks
    }


def _contact(log: FlightLog) -> Row | None:
    """When and where the hull first came to something, and what was believed then."""
    near = np.flatnonzero(log.clearance < TOUCH)
    if not log.collisions or not len(near):
        return None
    k = int(near[0])
    return {
        "time_s": round(float(log.time[k]), 2),
        "place": np.round(log.truth[k, :3], 2).tolist(),
        "position_error_m": float(np.linalg.norm(log.believed[k, :3] - log.truth[k, :3])),
        "emergency_before": int(np.count_nonzero(log.emergency[max(0, k - 20) : k + 1])),
        "status": log.statuses[k],
    }


def read_rows(store: Path, code: str | None) -> list[Row]:
    """Finished flights, of one state of the code if it is given; a line that was cut off does not count."""
    rows: list[Row] = []
    for text in store.read_text(encoding="utf-8").splitlines() if store.is_file() else []:
        try:
            row = json.loads(text)
        except json.JSONDecodeError:
            continue
        if code is None or row["code"] == code:
            rows.append(row)
    return rows


def run_jobs(jobs: Sequence[Job], store: Path, processes: int) -> list[Row]:
    """Fly what is left to fly; every row is written as soon as it is there."""
    rows: list[Row] = []
    alone = [job for job in jobs if job.study == "timing"]
    together = [job for job in jobs if job.study != "timing"]
    with store.open("a", encoding="utf-8") as file, tqdm(total=len(jobs), unit="flight") as bar:
        for batch, workers in ((together, processes), (alone, 1)):
            pool = None
            if batch and workers > 1:
                pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"))
            try:
                for row in campaign(fly, batch, pool):
                    file.write(json.dumps(row) + "\n")
                    file.flush()
                    rows.append(row)
                    bar.set_postfix_str(f"{row['study']}, {row['solver']}, {row['coupling']}, seed {row['seed']}")
                    bar.update()
            finally:
                if pool is not None:
                    pool.shutdown(cancel_futures=True)
    return rows


def _range(text: str) -> range:
    begin, _, end = text.partition(":")
    if not (begin.isdecimal() and end.isdecimal() and int(begin) < int(end)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a range of seeds: expected FIRST:END, such as 0:100")
    return range(int(begin), int(end))


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly what is missing and rewrite the results in docs/quadrotor-mpc.md."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quadrotor_flights", description=__doc__)
    parser.add_argument("--studies", nargs="+", choices=STUDIES, default=STUDIES)
    parser.add_argument("--seeds", type=_range, default=CORRIDOR_SEEDS, metavar="FIRST:END")
    parser.add_argument("--solvers", nargs="+", choices=SOLVERS, default=SOLVERS)
    parser.add_argument("--couplings", nargs="+", choices=COUPLINGS, default=COUPLINGS)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--store", type=Path, default=OUT / "quadrotor_flights.jsonl", metavar="FILE")
    parser.add_argument("--fresh", action="store_true", help="forget earlier flights")
    parser.add_argument("--report", action="store_true", help="only rewrite the page from what has been flown")
    parser.add_argument("--any-code", action="store_true", help="count flights of earlier states of the code, too")
    options = parser.parse_args(arguments)
    store: Path = options.store
    store.parent.mkdir(parents=True, exist_ok=True)
    if options.fresh:
        store.unlink(missing_ok=True)
    code = code_digest("benchmarks.quadrotor_flights")
    rows = read_rows(store, None if options.any_code else code)
    jobs = jobs_of(options.studies, options.solvers, options.couplings, options.seeds, code)
    done = {tuple(row["key"][:-1]) for row in rows}
    todo = [] if options.report else [job for job in jobs if job.key[:-1] not in done]
    rows += run_jobs(todo, store, options.processes)
    # Flights on other seeds, such as those for tuning, are no results.
    rows = [row for row in rows if row["seed"] in options.seeds]
    if not rows:
        print(f"Nothing on file in {store} for this state of the code.")
        return 1
    text = f"{machine('numpy', 'scipy', 'numba', 'osqp', 'piqp', 'pymunk')}\n\n{render(rows)}"
    store.with_suffix(".md").write_text(text + "\n", encoding="utf-8", newline="\n")
    print(text)
    if set(options.seeds) <= set(CORRIDOR_SEEDS):
        codes = {str(row["code"]) for row in rows}
        put_results(CHECKOUT / "docs" / "quadrotor-mpc.md", "Scenario: quadrotor-mpc", text, codes)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
