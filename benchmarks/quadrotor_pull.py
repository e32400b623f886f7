"""How far one graph pulls its estimate: the plan's costs against what the past alone says, tick by tick.

    python -m benchmarks.quadrotor_pull [--seeds 8] [--seconds 6] [--workers K] [--fresh] [--report]

The first seconds of flights through corridors on seeds that are open to tuning, with the weight of the future's costs,
the bound on the pull and what the window carries on swept. Every variant of a seed meets the same corridor, mass,
wind, disturbances and noise; differences are taken seed by seed. Writes docs/quadrotor-joint.md.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.campaign import campaign, interval
from benchmarks.quadrotor_flights import SOLVERS
from benchmarks.report import CHECKOUT, OUT, code_digest, machine, put_results, table
from unifg.models import quadrotor
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.flying.coupling import make_pilot
from unifg.scenarios.flying.joint import JointSettings
from unifg.scenarios.flying.joint_pilot import JointPilot, joint_pilot
from unifg.scenarios.flying.plan import Avoidance
from unifg.scenarios.seeing.belief import Belief, Landmarks
from unifg.scenarios.worlds.layouts import TUNING_SEEDS
from unifg.typing import Array

Row = dict[str, Any]

WEIGHTS = (0.01, 0.1, 1.0, 10.0)
PULLS = (np.inf, 0.5)
AVOIDANCES: tuple[Avoidance, ...] = ("clearance", "potential")
WARMING_UP = 5  # ticks whose times do not count


@dataclass(frozen=True)
class Job:
    """The beginning of one flight."""

    seed: int
    seconds: float
    code: str
    coupling: str = "joint"
    solver: str = "ipm"
    weight: float = 1.0
    pull: float = 0.5
    avoidance: Avoidance = "clearance"

    @property
    def key(self) -> str:
        """What makes two flights the same."""
        return json.dumps(asdict(self))

    @property
    def variant(self) -> tuple[Any, ...]:
        """What is compared over seeds."""
        return self.coupling, self.solver, self.weight, self.pull, self.avoidance


def jobs_of(seeds: list[int], seconds: float, code: str) -> list[Job]:
    """All variants on some seeds."""
    jobs = []
    for seed in seeds:
        plain = Job(seed, seconds, code)
        jobs += [replace(plain, coupling="sequential", avoidance=how) for how in AVOIDANCES]
        jobs += [replace(plain, weight=weight, pull=pull) for pull in PULLS for weight in WEIGHTS]
        jobs += [replace(plain, pull=pull, avoidance="potential") for pull in PULLS]
        jobs += [replace(plain, solver=solver) for solver in SOLVERS if solver != plain.solver]
    return jobs


def flight_of(job: Job) -> Flight:
    """World and pilot."""
    settings = FlightSettings(job.solver, job.coupling, job.seed)
    controller = replace(settings.controller, control_weight=job.weight, avoidance=job.avoidance)
    flight = Flight(replace(settings, controller=controller))
    found = flight.conditions
    believed = flight.pilot.belief.state
    common = (found.layout, believed, found.nominal, settings.estimator, controller)
    if job.coupling == "joint":
        flight.pilot = joint_pilot(job.solver, *common, JointSettings(job.pull))
    else:
        flight.pilot = make_pilot(job.coupling, job.solver, *common)
    return flight


def fly(job: Job) -> Row:
    """Fly for some seconds and measure, at every tick, the pull and the errors."""
    flight = flight_of(job)
    world, pilot, dt = flight.world, flight.pilot, flight.settings.controller.dt
    control: Array | None = None
    ticks: list[dict[str, float]] = []
    cylinders = world.layout.cylinders[:, :2]
    clearance, emergencies = np.inf, 0
    for _ in range(round(job.seconds / dt)):
        reading = world.sense()
        begin = time.process_time()
        plan = pilot.tick(reading, control)
        spent = 1e3 * (time.process_time() - begin)
        belief = pilot.belief
        alone = pilot.controller.alone if isinstance(pilot, JointPilot) else belief
        ticks.append({**pulled(belief, alone), **errors(belief, world.state, flight, cylinders), "tick": spent})
        emergencies += plan.emergency
        control = plan.controls[0]
        world.step(control, dt)
        clearance = min(clearance, world.clearance())
        if world.collisions:
            break
    numbers = {name: np.array([tick[name] for tick in ticks]) for name in ticks[0]}
    row: Row = {"key": job.key, "collisions": world.collisions, "emergencies": emergencies, "clearance": clearance}
    row["distance"] = float(world.state[0] - world.layout.start[0])
    known = {name: value[np.isfinite(value)] for name, value in numbers.items()}
    row["mean"] = {name: float(value.mean()) for name, value in known.items() if len(value)}
    row["max"] = {name: float(value.max()) for name, value in known.items() if len(value)}
    row["tick"] = numbers["tick"][WARMING_UP:].tolist()
    return row


def pulled(belief: Belief, alone: Belief) -> dict[str, float]:
    """How far a belief is from what the past alone says."""
    step = quadrotor.STATE.local(alone.state[None], belief.state[None])[0]
    rho, without = belief.parameters, alone.parameters
    moved = belief.landmarks.positions - alone.landmarks.positions
    sigma = np.sqrt(np.diagonal(alone.landmarks.covariances, axis1=1, axis2=2))
    unsure = alone.parameters_sigma > 0.0
    about = np.abs(rho.packed - without.packed)[unsure] / alone.parameters_sigma[unsure]
    return {
        "position": float(np.linalg.norm(step[:3])),
        "velocity": float(np.linalg.norm(step[6:])),
        "mass": abs(rho.mass / without.mass - 1.0),
        "wind": float(np.hypot(*np.subtract(rho.wind, without.wind))),
        "landmarks": float(np.hypot(*moved.T).max(initial=0.0)),
        "sigma": float(max(np.abs(step / alone.sigma).max(), about.max(), np.abs(moved / sigma).max(initial=0.0))),
    }


def errors(belief: Belief, truth: Array, flight: Flight, cylinders: Array) -> dict[str, float]:
    """How far a belief is from the truth."""
    step = quadrotor.STATE.local(truth[None], belief.state[None])[0]
    true, found = flight.conditions.true, belief.parameters
    marks = belief.landmarks
    body = marks.kinds == Landmarks.CYLINDER
    wrong = np.hypot(*(marks.positions[body] - cylinders[marks.ids[body]]).T)
    return {
        "position error": float(np.linalg.norm(step[:3])),
        "velocity error": float(np.linalg.norm(step[6:])),
        "mass error": abs(found.mass / true.mass - 1.0),
        "wind error": float(np.hypot(*np.subtract(found.wind, true.wind))),
        "cylinder error": float(wrong.mean()) if len(wrong) else np.nan,
    }


# ---------------------------------------------------------------- the page

PULLED = {
    "position [mm]": ("position", 1e3),
    "velocity [mm/s]": ("velocity", 1e3),
    "mass [%]": ("mass", 1e2),
    "wind [mm/s^2]": ("wind", 1e3),
    "landmark [mm]": ("landmarks", 1e3),
    "most of all [sigma]": ("sigma", 1.0),
}
ERRORS = {
    "position [mm]": ("position error", 1e3),
    "velocity [mm/s]": ("velocity error", 1e3),
    "mass [%]": ("mass error", 1e2),
    "wind [mm/s^2]": ("wind error", 1e3),
    "cylinders [mm]": ("cylinder error", 1e3),
}


def of_variant(rows: list[Row], variant: tuple[Any, ...]) -> dict[int, Row]:
    """Rows of one variant by seed."""
    found = {}
    for row in rows:
        job = Job(**json.loads(row["key"]))
        if job.variant == variant:
            found[job.seed] = row
    return dict(sorted(found.items()))


def digits(value: float, sign: str = "") -> str:
    """Two significant digits, all of those before the point."""
    return f"{value:{sign}.0f}" if abs(value) >= 10.0 else f"{value:{sign}.2g}"


def bound(pull: float) -> str:
    """A bound on the pull in words."""
    return "none" if np.isinf(pull) else f"{pull:g}"


def pull_table(groups: list[tuple[list[str], dict[int, Row]]], head: list[str]) -> str:
    """Mean over all ticks and greatest of any tick."""
    lines = []
    for words, rows in groups:
        line = list(words)
        for name, scale in PULLED.values():
            mean = scale * float(np.mean([row["mean"][name] for row in rows.values()]))
            most = scale * max(row["max"][name] for row in rows.values())
            line.append(f"{digits(mean)} ({digits(most)})")
        lines.append(line)
    return table([*head, *PULLED], lines, len(head))


def error_table(groups: list[tuple[list[str], dict[int, Row]]], head: list[str], base: dict[int, Row]) -> str:
    """Errors, the first row's as they are, the others' with their paired difference to it."""
    lines = []
    for words, rows in groups:
        line = list(words)
        for name, scale in ERRORS.values():
            both = [seed for seed in rows if all(np.isfinite(r[seed]["mean"].get(name, np.nan)) for r in (rows, base))]
            mine, other = (scale * np.array([r[seed]["mean"][name] for seed in both]) for r in (rows, base))
            if rows is base:
                line.append(f"{mine.mean():.3g}")
                continue
            low, high = interval(mine - other)
            line.append(f"{mine.mean():.3g} ({digits(low, '+')} .. {digits(high, '+')})")
        least = min(row["clearance"] for row in rows.values())
        line.append(f"{np.mean([row['distance'] for row in rows.values()]):.2f}")
        line.append(f"{100 * least:.0f}")
        line.append(str(sum(row["emergencies"] for row in rows.values())))
        line.append(str(sum(row["collisions"] for row in rows.values())))
        times = np.concatenate([row["tick"] for row in rows.values()])
        line.append(f"{np.median(times):.1f} ({np.quantile(times, 0.99):.1f})")
        lines.append(line)
    flown = ["flown [m]", "least clearance [cm]", "emergencies", "collisions", "tick [ms]"]
    return table([*head, *ERRORS, *flown], lines, len(head))


def render(rows: list[Row], seeds: list[int], seconds: float) -> str:
    """Markdown of all variants."""
    plain = Job(0, seconds, "")
    parts = [
        machine("numpy", "scipy", "numba", "pymunk"),
        f"Flights on {len(seeds)} seeds from {seeds[0]} on, the first {seconds:g} s of each.",
    ]
    base = of_variant(rows, replace(plain, coupling="sequential").variant)
    head = ["pull", "control weight"]
    groups: list[tuple[list[str], dict[int, Row]]] = [
        (
            [bound(pull), f"{weight:g}"],
            of_variant(rows, replace(plain, weight=weight, pull=pull).variant),
        )
        for pull in PULLS
        for weight in WEIGHTS
    ]
    parts += ["### How far the plan pulls", pull_table(groups, head)]
    parts.append("Distance from what the past alone says: mean over ticks, in brackets the greatest of any tick.")
    sequential = (["sequential", "-"], base)
    parts += ["### What that does to estimates and flights", error_table([sequential, *groups], head, base)]
    parts.append(
        "Errors are means over ticks and seeds; in brackets the 95 % interval of the paired difference to sequential. "
        "Emergencies are ticks whose solve gave nothing that may be flown. Ticks are process times, median and, in "
        "brackets, 99th percentile."
    )
    potential = [
        ([bound(pull)], of_variant(rows, replace(plain, pull=pull, avoidance="potential").variant)) for pull in PULLS
    ]
    start = of_variant(rows, replace(plain, coupling="sequential", avoidance="potential").variant)
    parts += ["### Ta's own costs", pull_table(potential, ["pull"])]
    parts.append(error_table([(["sequential"], start), *potential], ["pull"], start))
    backends = [([solver], of_variant(rows, replace(plain, solver=solver).variant)) for solver in SOLVERS]
    parts += ["### Backends, weight 1, pull 0.5", pull_table(backends, ["backend"])]
    parts.append(error_table([(["sequential, ipm"], base), *backends], ["backend"], base))
    return "\n\n".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Fly what is missing and rewrite docs/quadrotor-joint.md."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.quadrotor_pull", description=__doc__)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--seconds", type=float, default=6.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--fresh", action="store_true", help="forget earlier flights")
    parser.add_argument("--report", action="store_true", help="only rewrite the page from what has been flown")
    options = parser.parse_args(arguments)
    store = OUT / "quadrotor_pull.jsonl"
    store.parent.mkdir(parents=True, exist_ok=True)
    if options.fresh:
        store.unlink(missing_ok=True)
    rows = [json.loads(line) for line in store.read_text().splitlines()] if store.exists() else []
    code, seeds = code_digest("benchmarks.quadrotor_pull"), list(TUNING_SEEDS[: options.seeds])
    rows = rows if options.report else [row for row in rows if json.loads(row["key"])["code"] == code]
    done = {row["key"] for row in rows}
    todo = [] if options.report else [job for job in jobs_of(seeds, options.seconds, code) if job.key not in done]
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(options.workers, mp_context=spawn) if options.workers > 1 else None
    with store.open("a") as file:
        for row in tqdm(campaign(fly, todo, pool), total=len(todo), desc="pull"):
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
    page = CHECKOUT / "docs" / "quadrotor-joint.md"
    codes = {json.loads(row["key"])["code"] for row in rows}
    put_results(page, "One graph that estimates and flies", render(rows, seeds, options.seconds), codes)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
