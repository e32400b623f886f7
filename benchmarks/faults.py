"""Faults of sensors and actuators, one by one: how drives and flights end.

Drives along the corridor of the shipped building and flights through the corridor of cylinders, each with one fault,
for a while or for good. Counted are drives and flights that ended by name, contacts, and exceptions; none may be
raised. Of a flight that touched something the stopping set is tested: from the state in which the fault found it, the
same world is flown on as it was for a reaction time, and then braked with true state and true wind in view. Where that
touches nothing, the contact could have been avoided.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from itertools import product

from benchmarks.comparison import Row, grouped
from benchmarks.report import table
from benchmarks.runner import Cell, Study
from unifg.scenarios.flight import FlightSettings, run_flight
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.logs.flight_log import FlightLog
from unifg.scenarios.logs.flight_metrics import flight_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.scenarios.quadrotor.braking import braking_control
from unifg.scenarios.simulation.air import QuadrotorWorld
from unifg.scenarios.simulation.conditions import draw_conditions
from unifg.scenarios.simulation.disturbance import DisturbanceModel
from unifg.scenarios.simulation.faults import DRIVE_FAULTS, FLIGHT_FAULTS, SIZES, Fault

ROBOTS = {"drive": DRIVE_FAULTS, "flight": FLIGHT_FAULTS}
BEGIN = {"drive": 2.0, "flight": 3.0}  # [s]
DURATIONS = (2.0, 1000.0)  # [s]; the second one for good
GUST_TIMES = (0.5, 2.0)  # [s]; no flight goes on against a gale for good
REACTION = 2  # ticks: the one in which something is felt, and the one that answers
START, GOAL = (6.5, 14.0, 0.0), (13.5, 14.1, 0.0)


def run(robot: str, fault: Fault, seed: int) -> EpisodeLog | FlightLog:
    """Drive or fly with one fault."""
    if robot == "drive":
        return run_navigation(NavigationSettings(start=START, goals=(GOAL,), obstacles=1, seed=seed, faults=(fault,)))
    return run_flight(FlightSettings(seed=seed, time_limit=30.0, faults=(fault,)))


def first_named(log: EpisodeLog | FlightLog) -> float | None:
    """Time of the first tick that is not well [s]."""
    return next((float(time) for time, health in zip(log.time, log.health, strict=True) if health != "ok"), None)


def episode(robot: str, fault: str, duration: float, seed: int) -> Row:
    """Run one; an exception is what is looked for, and kept."""
    braked: float | None = None
    try:
        log = run(robot, Fault(fault, BEGIN[robot], duration), seed)
        m = episode_metrics(log) if isinstance(log, EpisodeLog) else flight_metrics(log)
        outcome = log.outcomes[0] if isinstance(log, EpisodeLog) else log.outcome
        first = first_named(log)
        if isinstance(log, FlightLog) and m["collisions"]:
            braked = stopped_clear(fault, duration, seed, log)
    except Exception as error:
        return {"raised": f"{type(error).__name__}: {error}"}
    return {
        "braked": braked,
        "outcome": outcome, "collisions": m["collisions"], "causes": m["causes"], "first": first,
    }  # fmt: skip


def stopped_clear(fault: str, duration: float, seed: int, log: FlightLog) -> float:
    """Least clearance [m] of the vehicle of a flight that brakes as well as can be, over the time of the fault."""
    settings = FlightSettings(seed=seed)
    begin = round(BEGIN["flight"] / log.dt)
    true = draw_conditions(seed, settings.mass_error).true
    gust = SIZES["gust"] if fault == "gust" else 0.0
    true = replace(true, wind=(true.wind[0], true.wind[1] + gust))
    world = QuadrotorWorld(log.layout, seed, true, start=log.truth[begin], disturbance=DisturbanceModel.calm())
    box, clearance = settings.controller.box, world.clearance()
    for tick in range(round(min(duration, GUST_TIMES[-1]) / log.dt)):
        braking = braking_control(world.state, true, *box)
        world.step(log.controls[begin + tick] if tick < REACTION else braking, log.dt)
        clearance = min(clearance, world.clearance())
    return clearance


def cases(seeds: Iterable[int]) -> list[Cell]:
    """All of them."""
    found = list[Cell]()
    for robot, faults in ROBOTS.items():
        for fault, seed in product(faults, seeds):
            times = GUST_TIMES if fault == "gust" else DURATIONS
            found += [{"robot": robot, "fault": fault, "duration": time, "seed": seed} for time in times]
    return found


def named(row: Row) -> str:
    """The cause that was named longest."""
    causes: dict[str, int] = row.get("causes", {})
    return max(causes, key=lambda cause: causes[cause]) if causes else "-"


def render(rows: list[Row]) -> str:
    """The table, and the sums above it."""
    order = {
        (robot, fault): (k, n) for k, (robot, faults) in enumerate(ROBOTS.items()) for n, fault in enumerate(faults)
    }
    ordered = sorted(rows, key=lambda row: (*order[row["robot"], row["fault"]], row["duration"], row["seed"]))
    lines = []
    for (robot, fault, duration), mine in grouped(ordered, "robot", "fault", "duration").items():
        ended = [row for row in mine if "outcome" in row]
        words = Counter(named(row) for row in ended)
        begun = [row["first"] - BEGIN[robot] for row in ended if row["first"] is not None]
        lines.append(
            (
                robot, fault, "for good" if duration >= DURATIONS[1] else f"{duration:g} s", str(len(mine)),
                str(sum(row["outcome"] == "reached" for row in ended)),
                str(sum(row["outcome"] != "reached" for row in ended)),
                str(sum(row["collisions"] for row in ended)), str(len(mine) - len(ended)),
                "; ".join(f"{word} ({count})" if len(words) > 1 else word for word, count in words.most_common(2)),
                f"{max(begun):.2f}" if begun else "-",
            )
        )  # fmt: skip
    ended = [row for row in rows if "outcome" in row]
    sums = (
        f"{len(rows)} episodes with a fault: {len(rows) - len(ended)} exceptions, "
        f"{sum(row['collisions'] > 0 for row in ended)} episodes with a contact, "
        f"{sum(row['outcome'] == 'reached' for row in ended)} that went on to the goal, "
        f"{sum(row['outcome'] != 'reached' for row in ended)} that ended elsewhere, by name."
    )
    head = (
        "robot", "fault", "lasts", "episodes", "reached", "stopped", "contacts", "exceptions", "cause named",
        "at most after [s]",
    )  # fmt: skip
    contacts = [
        f"`{row['robot']}`, {row['fault']}, {row['duration']:g} s, seed {row['seed']}: "
        f"{row['collisions']} contacts, {row['outcome']}{_avoidable(row['braked'])}"
        for row in ended
        if row["collisions"]
    ]
    listed = "\n".join(f"- {line}" for line in contacts)
    parts = [sums, table(head, lines, text=3), *([f"Episodes with contacts:\n\n{listed}"] if contacts else [])]
    return "\n\n".join(parts)


def _avoidable(braked: float | None) -> str:
    """Words about the clearance that the stopping set leaves [m]."""
    if braked is None:
        return ""
    return f"; the stopping set keeps {braked:.2f} m" if braked > 0.0 else "; the stopping set touches as well"


STUDY = Study(cases, episode, render, range(5))
