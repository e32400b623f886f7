"""``unifg run manoeuvres``: the cases that were asked for, their scenes and pictures, and one file of numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from unifg.scenarios import manoeuvres
from unifg.scenarios.commands.outcome import Outcome, Progress, Writer
from unifg.scenarios.commands.watching import Announce, watching_iterates
from unifg.scenarios.logs.metrics import write_metrics
from unifg.scenarios.logs.solved_log import SolvedLog, held
from unifg.scenarios.options import Settings, option
from unifg.scenarios.scenes.manoeuvre_plot import picture
from unifg.scenarios.scenes.manoeuvre_scene import manoeuvre_iterate, manoeuvre_scene, manoeuvre_stage
from unifg.solution.status import Status
from unifg.style.figures import write_figure

__all__ = ["SETTINGS", "run"]


@dataclass(frozen=True)
class CaseSettings(Settings):
    """Settings of manoeuvres.

    Attributes:
        case: which manoeuvre.
        solver: one of `unifg.solvers.names.CONSTRAINED`.
    """

    case: str = option("both", choices=(*manoeuvres.CASES, "both"))
    solver: str = "sqp"


SETTINGS = CaseSettings


def run(settings: CaseSettings, progress: Progress, announce: Announce | None = None) -> Outcome:
    """Solve one case after the other."""
    names = tuple(manoeuvres.CASES) if settings.case == "both" else (settings.case,)
    solved: list[manoeuvres.Manoeuvre] = []
    interrupted = False
    for number, name in enumerate(names):

        def part(done: float, text: str, name: str = name, number: int = number) -> None:
            progress((number + done) / len(names), f"{name}: {text}")

        case = manoeuvres.CASES[name]
        with watching_iterates(announce, manoeuvre_stage(case), manoeuvre_iterate, part) as watch:
            solved.append(manoeuvres.run_manoeuvre(case, settings.solver, progress=watch))
        interrupted = solved[-1].solution.status is Status.INTERRUPTED
        if interrupted:
            break
    progress(1.0, "solved")

    numbers = manoeuvres.metrics_of(solved)

    files: dict[str, Writer] = {"metrics.json": lambda path: write_metrics(path, numbers)}
    for one in solved:
        files |= _pictures(one)
    logs = {one.case.name: _driven(one) for one in solved}
    return Outcome(all(m.succeeded for m in solved), interrupted, manoeuvres.table(solved), numbers, files, logs)


def _driven(solved: manoeuvres.Manoeuvre) -> SolvedLog:
    """The plan as if it had been driven."""
    control, settings = held(solved.controls), solved.settings
    return SolvedLog(
        discs=np.array(solved.case.discs).reshape(-1, 3),
        time=settings.dt * np.arange(len(control), dtype=np.float64),
        pose=solved.states,
        wanted=solved.case.reference(settings),
        speed=control[:, 0],
        control=control,
    )


def _pictures(solved: manoeuvres.Manoeuvre) -> dict[str, Writer]:
    """Picture and scene of one case."""
    return {
        f"{solved.case.name}.png": lambda path: write_figure(path, picture(solved), 105),
        f"{solved.case.name}.html": lambda path: manoeuvre_scene(solved).save(path),
    }
