"""``unifg warmup``: everything compiled before it is needed, the scenarios' own functions too."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numba

from unifg.codegen import precompiled
from unifg.codegen.cache_folder import VARIABLE, cache_folder
from unifg.codegen.compile_counter import Tally
from unifg.errors import ScenarioError
from unifg.precompile import Job, Progress, jobs, perform

__all__ = ["missing", "run", "ship"]


def missing() -> str:
    """Name of a package that the scenarios need and that is not installed, "" without one."""
    try:
        list(_scenarios())
    except ModuleNotFoundError as error:
        return error.name or str(error)
    return ""


def run(progress: Progress, anew: bool = False, processes: int = 1) -> Tally:
    """Compile what the library and its scenarios can reach, or find that it is there; no scenarios without extras.

    Raises:
        ScenarioError: there is no folder that could keep it.
    """
    if cache_folder() is None:  # which logs the reason
        raise ScenarioError(f"what warmup compiles could not be kept: name a folder in {VARIABLE}")
    if missing():
        return perform("library", lambda: list(jobs()), progress, anew, processes)
    return perform("all", lambda: [*jobs(), *_scenarios()], progress, anew, processes)


def ship(progress: Progress) -> Path:
    """Compile everything anew and write the archive of half compiled kernels that comes with the library.

    It is optimised for no processor: what is, with vectors of eight, is a tenth slower in the short loops of factors.

    Raises:
        ScenarioError: Numba optimises for this processor; or, once the archive is written, a function raises errors by
            which it cannot be part of it.
    """
    if numba.config.CPU_NAME != "generic":
        raise ScenarioError("kernels that ship are for no processor: set NUMBA_CPU_NAME=generic (make kernels)")
    list(_scenarios())  # raises without the extras that they need
    with precompiled.recording() as recorder:
        run(progress, anew=True)
    recorder.write(precompiled.ARCHIVE)
    if refused := [name for name, reason in recorder.left_out.items() if reason.startswith("raises")]:
        raise ScenarioError(f"compiled on first use by everybody: {', '.join(refused)}: write loops instead of slices")
    return precompiled.ARCHIVE


def _scenarios() -> Iterator[Job]:
    """Jobs of the scenarios, which need extras."""
    from unifg.scenarios import course, flight, manoeuvres, navigation, safe_flight, velocity_tracking
    from unifg.scenarios.quadrotor.flight_pilot import COUPLINGS

    for coupling in ("sequential", "joint"):
        drive = navigation.NavigationSettings(coupling=coupling)
        yield f"navigation, {coupling}", partial(navigation.Episode, drive)
    for coupling in COUPLINGS:
        settings = flight.FlightSettings(coupling=coupling)
        yield f"flight, {coupling}", partial(flight.Flight, settings)
    yield "course", course.run_course
    yield "flight past a cylinder", partial(safe_flight.flights, safe_flight.SafeSettings())
    yield "velocity tracking", velocity_tracking.run_tracking
    for name, case in manoeuvres.CASES.items():
        yield f"manoeuvre {name}", partial(manoeuvres.run_manoeuvre, case)
