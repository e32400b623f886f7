"""Scenarios that ``unifg run``, ``solve``, ``map``, ``localise`` and campaigns can run, and their modules.

To add one, write a module of `unifg.scenarios.commands` with ``SETTINGS``, a class whose fields are options
(`unifg.scenarios.options`), and ``run``, which takes them and returns an outcome; then give it a line here.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib import import_module
from pathlib import Path
from typing import Any

from unifg.scenarios.options import Unasked, add_options

__all__ = ["FROM_FILES", "SCENARIOS", "Scenario"]


@dataclass(frozen=True)
class Scenario:
    """One entry of `SCENARIOS`.

    Attributes:
        module: of `unifg.scenarios.commands`: its ``SETTINGS`` are a class whose fields are options, its ``run`` takes
            them, a progress and, where it can be watched, whom to tell where; it raises KeyboardInterrupt when stopped
            before there is anything to write.
        summary: one line for the help.
        solvers: the list of `unifg.solvers.names` to choose from; empty for none.
        defaults: of options, where the command line has others than the settings.
        live: whether it can be watched.
        first: flags that its help shows before the word "all" is given; empty for every one.
        extras: that it needs, where it is no scenario of ``unifg run``.
    """

    module: str
    summary: str
    solvers: str = "CONSTRAINED"
    defaults: Mapping[str, Any] = field(default_factory=dict)
    live: bool = True
    first: tuple[str, ...] = ()
    extras: tuple[str, ...] = ()

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Load the scenario and add its options."""
        from unifg.solvers import names

        module = import_module(f"unifg.scenarios.commands.{self.module}")
        add_options(parser, module.SETTINGS, **self.defaults)
        if self.solvers:
            solvers = getattr(names, self.solvers)
            solver = next(f.default for f in fields(module.SETTINGS) if f.name == "solver")
            about = f"{names.choices(solvers)} (default: {solver})"
            parser.add_argument("--solver", choices=solvers, default=argparse.SUPPRESS, help=about)
        parser.add_argument(
            "--out", type=Path, default=Path("out"), metavar="DIR", help="folder for results (default: %(default)s)"
        )
        parser.add_argument(
            "--set", action="append", default=[], metavar="NAME=VALUE", dest="stated",
            help="any setting by its name, such as controller.margin=0.3; may be repeated",
        )  # fmt: skip
        if self.live:
            parser.add_argument(
                "--mcap", action="store_true", help="write the log as MCAP, too, which Foxglove and PlotJuggler play"
            )
            parser.add_argument("--live", action="store_true", help="show it in a browser while it runs; says where")
        parser.set_defaults(module=module)


SCENARIOS = {
    "navigation": Scenario(
        "drives",
        "A robot localises itself by lidar and drives through a building under MPC.",
        defaults={"obstacles": Unasked(3)},
        first=(
            "--map",
            "--start",
            "--goal",
            "--base",
            "--body",
            "--speed",
            "--plant",
            "--obstacles",
            "--planner",
            "--localiser",
            "--solver",
            "--out",
        ),
    ),
    "manoeuvres": Scenario(
        "manoeuvre_cases",
        "Two control graphs solved once: backing out of a wrong heading, and deflecting around an unforeseen disc.",
    ),
    "velocity-tracking": Scenario(
        "speed_tracking",
        "Forces that make a car follow a speed profile: one optimal control problem over the whole drive.",
        "CONSTRAINED",
    ),
    "quadrotor-mpc": Scenario(
        "flights",
        "A quadrotor flies through a corridor of unknown cylinders, estimating and planning on factor graphs.",
    ),
    "quadrotor-obstacles": Scenario(
        "courses",
        "A quadrotor's flight past three walls and a cylinder, optimised as a whole.",
        "SECOND_ORDER",
    ),
    "quadrotor-cbf": Scenario(
        "safe_flights",
        "A quadrotor keeps its distance by control barriers: a cylinder, things that move, clutter, a thrown ball.",
    ),
}
"""Everything ``unifg run`` can run."""

FROM_FILES = {
    "solve": Scenario(
        "graphs", "Solve a pose graph from a file (g2o or TORO, gzipped or not).", "LEAST_SQUARES", live=False
    ),
    "map": Scenario(
        "maps",
        "Make a map of a log of a lidar and wheels (CARMEN, CSV, MCAP, rosbag2, drive.npz).",
        "",
        live=False,
        extras=("view",),
    ),
    "localise": Scenario(
        "replays", "Follow a log of a lidar and wheels on a map.", "", live=False, extras=("view", "scenarios")
    ),
}
"""Commands that begin with a file: ``unifg solve``, ``unifg map``, ``unifg localise``."""
