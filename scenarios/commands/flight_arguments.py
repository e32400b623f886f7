"""Arguments of ``unifg run quadrotor-mpc``; apart from the scenario, whose imports help does not need."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from unifg.scenarios.commands.outcome import Outcome, Progress

if TYPE_CHECKING:
    from unifg.scenarios.flight import FlightSettings

__all__ = ["DESCRIPTION", "add_arguments", "run"]

DESCRIPTION = "A quadrotor flies through a corridor of unknown cylinders, estimating and planning on factor graphs."


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the scenario's own options, but not ``--solver``, ``--seed`` and ``--out``."""
    parser.add_argument(
        "--coupling",
        choices=("separate", "sequential", "joint"),
        default="sequential",
        help="of estimation and control: without dynamics in the estimator; both with the same parameters; one graph "
        "(default: %(default)s)",
    )
    parser.add_argument(
        "--association",
        choices=("known", "unknown"),
        default="known",
        help="whether the sensor names what it sees (default: %(default)s)",
    )
    parser.add_argument(
        "--avoidance",
        choices=("clearance", "potential"),
        default="clearance",
        help="hard clearance, or the cost 1/d of Ta et al. (default: %(default)s)",
    )
    parser.add_argument("--movers", type=_count, default=0, metavar="K", help="moving discs (default: %(default)s)")
    parser.add_argument(
        "--mass-error",
        type=_share,
        default=0.05,
        metavar="E",
        help="by which the mass is believed wrong at the start, relative, in [0, 1) (default: %(default)s)",
    )


def settings_of(chosen: argparse.Namespace) -> FlightSettings:
    """The flight that was asked for."""
    from unifg.scenarios.flight import FlightSettings  # imports the physics engine

    plain = FlightSettings(
        chosen.solver, chosen.coupling, chosen.seed, movers=chosen.movers, mass_error=chosen.mass_error
    )
    return replace(
        plain,
        estimator=replace(plain.estimator, association=chosen.association),
        controller=replace(plain.controller, avoidance=chosen.avoidance),
    )


def run(chosen: argparse.Namespace, progress: Progress) -> Outcome:
    """Fly.

    Raises:
        KeyboardInterrupt: when stopped before the first tick.
        ScenarioError: when the movers do not fit into the corridor.
    """
    from unifg.scenarios.commands.flight_results import summary, write_results
    from unifg.scenarios.flight import run_flight

    log = run_flight(settings_of(chosen), progress)
    if log.ticks == 0:
        raise KeyboardInterrupt
    return Outcome(log.succeeded, log.interrupted, summary(log), lambda folder: write_results(folder, log))


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)


def _share(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < 1.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number in [0, 1)")
    return value
