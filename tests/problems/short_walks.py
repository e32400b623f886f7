"""A scenario of a few microseconds that can go wrong in every way, for tests of campaigns."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from unifg.errors import ScenarioError
from unifg.scenarios.commands.outcome import Outcome
from unifg.scenarios.options import existing, option, positive

Behaviour = Literal["walk", "fail", "raise", "refuse", "exit", "die", "die once", "nan", "slow", "stubborn", "threads"]


@dataclass(frozen=True)
class Shoes:
    """Settings inside settings.

    Attributes:
        size: of them.
        grip: of the soles.
    """

    size: int = 42
    grip: float = option(0.8, text=positive)


@dataclass(frozen=True)
class WalkSettings:
    """A walk.

    Attributes:
        behaviour: what happens.
        pace: length of a step [m].
        ways: some.
        map: a file.
        mark: a file that a worker writes before it dies, and whose presence keeps it alive.
        shoes: what it is walked in.
        seed: of the steps.
    """

    behaviour: Behaviour = option("walk")
    pace: float = option(1.0, text=positive)
    ways: tuple[tuple[float, float], ...] | None = option(None, many=True, flag="way")
    map: Path | None = option(None, text=existing("a map"))
    mark: str = ""
    shoes: Shoes = field(default_factory=Shoes)
    seed: int = option(0)

    def __post_init__(self) -> None:
        if self.pace > 100.0:
            raise ScenarioError("nobody walks that fast")


SETTINGS = WalkSettings


class Odd(Exception):
    """An exception that does not survive a pickle."""

    def __init__(self, one: int, other: int) -> None:
        super().__init__(f"{one} and {other}")


def run(settings: WalkSettings, progress: Callable[[float, str], None]) -> Outcome:
    for tick in range(3):
        progress(tick / 3, "walking")
    match settings.behaviour:
        case "raise":
            raise Odd(1, 2)
        case "refuse":
            raise ScenarioError("not today")
        case "exit":
            sys.exit(3)
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "die once" if not Path(settings.mark).exists():
            Path(settings.mark).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        case "slow":
            time.sleep(settings.pace)
        case "stubborn":
            time.sleep(60.0)
    steps = settings.pace * np.random.default_rng(settings.seed).standard_normal(5)
    numbers: dict[str, Any] = {
        "length_m": np.float64(np.abs(steps).sum()),
        "arrived": settings.behaviour != "fail",
        "steps": steps,
        "inside": {"least": float("nan") if settings.behaviour == "nan" else steps.min()},
    }
    if settings.behaviour == "threads":
        numbers |= {"threads": int(os.environ["OMP_NUM_THREADS"]), "pid": os.getpid()}
    return Outcome(settings.behaviour != "fail", False, "walked", numbers, {"walk.txt": _write})


def _write(path: Path) -> None:
    path.write_text("walked\n")
