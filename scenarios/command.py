"""The command ``unifg``: run a scenario, watch its progress, keep its results.

Exit status: 0 if the robot did what it was asked (every goal reached without a collision, every solve converged within
its limits), 1 if not, 2 for arguments that cannot be served, 130 after an interrupt (what was done until then is
written all the same).

Commands and scenarios are tables: to add one, write a function that describes its arguments and one that runs it.
"""

from __future__ import annotations

import argparse
import re
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from unifg import __version__
from unifg.answers.history import Iteration
from unifg.errors import UnifgError
from unifg.scenarios.commands import course_arguments as obstacles_arguments
from unifg.scenarios.commands import flight_arguments as mpc_arguments
from unifg.scenarios.commands import graph_arguments as solve_arguments
from unifg.scenarios.commands import velocity_arguments as velocity_tracking_arguments
from unifg.scenarios.commands.drive_results import summary, write_results
from unifg.scenarios.commands.outcome import Outcome, Progress
from unifg.solvers import names

__all__ = ["SCENARIOS", "Outcome", "Scenario", "main"]

SUCCEEDED, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130
COUPLINGS = ("sequential", "joint")
MANOEUVRES = ("behind", "obstacle")

Pose = tuple[float, float, float]

_PAIRED_OPTIONS = ("--start", "--goal", "--force-bounds")
_NEGATIVE = re.compile(r"-[\d.]")


@dataclass(frozen=True)
class Scenario:
    """One entry of `SCENARIOS`.

    Attributes:
        summary: one line for the help.
        arguments: adds the scenario's arguments to its parser.
        run: runs it; raises KeyboardInterrupt when stopped before there is anything to write.
        random: whether a seed makes a difference.
        solvers: names to choose from.
        solver: the default.
    """

    summary: str
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, Progress], Outcome]
    random: bool = True
    solvers: tuple[str, ...] = names.CONSTRAINED
    solver: str = "sqp"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: arguments without the program's name; None takes those of the process.
    """
    arguments = _join_negative(list(sys.argv[1:] if argv is None else argv))
    try:
        chosen = _parser().parse_args(arguments)
    except SystemExit as stop:  # argparse has said what is wrong, or has printed help
        return stop.code if isinstance(stop.code, int) else REFUSED
    command: Callable[[argparse.Namespace], int] = chosen.command
    try:
        return command(chosen)
    except UnifgError as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        print("unifg: interrupted before there was anything to write", file=sys.stderr)
        return INTERRUPTED


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="unifg", description="Robot estimation and control as one factor graph.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"unifg {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="run a scenario", description="Run a scenario.", allow_abbrev=False)
    scenarios = run.add_subparsers(title="scenarios", required=True, metavar="SCENARIO")
    for name, scenario in SCENARIOS.items():
        one = scenarios.add_parser(name, help=scenario.summary, description=scenario.summary, allow_abbrev=False)
        scenario.arguments(one)
        one.add_argument(
            "--solver",
            choices=scenario.solvers,
            default=scenario.solver,
            help=f"{names.choices(scenario.solvers)} (default: %(default)s)",
        )
        if scenario.random:
            one.add_argument("--seed", type=_count, default=0, metavar="S", help="of everything random (default: 0)")
        _add_out(one)
        one.set_defaults(command=_run, scenario=name, run=scenario.run)
    about = solve_arguments.DESCRIPTION
    solve = commands.add_parser("solve", help="solve a pose graph", description=about, allow_abbrev=False)
    solve_arguments.add_arguments(solve)
    _add_out(solve)
    solve.set_defaults(command=_run, scenario="solve", run=_run_solve)
    return parser


def _add_out(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="folder for results (default: %(default)s)"
    )


def _run(chosen: argparse.Namespace) -> int:
    """Run the chosen scenario, write what it left and say how it went."""
    folder: Path = chosen.out
    try:
        folder.mkdir(parents=True, exist_ok=True)  # better refused now than after the run
    except OSError as error:
        return _refuse(f"--out {folder}: cannot make this folder ({error.strerror})")
    with _progress_bar(chosen.scenario) as progress:
        outcome: Outcome = chosen.run(chosen, progress)
    try:
        files = outcome.write(folder)
    except OSError as error:
        return _refuse(f"--out {folder}: cannot write the results ({error})")
    print(outcome.summary)
    print()
    for file in files:
        print(file)
    if outcome.interrupted:
        return INTERRUPTED
    return SUCCEEDED if outcome.succeeded else FAILED


@contextmanager
def _progress_bar(name: str) -> Iterator[Progress]:
    """A bar on stderr; the first interrupt waits for the end of a tick, so that the record stays whole."""
    from tqdm import tqdm

    wanted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal wanted
        if wanted:  # it does not come to an end: stop at once
            raise KeyboardInterrupt
        wanted = True

    layout = "{desc} {percentage:3.0f}%|{bar}| {elapsed} {postfix}"
    with tqdm(total=1.0, desc=name, bar_format=layout, file=sys.stderr) as bar:

        def progress(done: float, text: str) -> None:
            nonlocal wanted
            bar.set_postfix_str(text, refresh=False)
            bar.update(max(0.0, min(done, 1.0) - bar.n))
            if wanted:
                wanted = False
                raise KeyboardInterrupt

        try:
            before = signal.signal(signal.SIGINT, interrupt)
        except ValueError:  # not in the main thread, where no interrupt arrives either
            yield progress
            return
        try:
            yield progress
        finally:
            signal.signal(signal.SIGINT, before)


def _refuse(message: str) -> int:
    print(f"unifg: error: {message}", file=sys.stderr)
    return REFUSED


def _join_negative(arguments: list[str]) -> list[str]:
    """``--start -2,-0.5,0`` as ``--start=-2,-0.5,0``: argparse would take the value for an option."""
    joined: list[str] = []
    for argument in arguments:
        if joined and joined[-1] in _PAIRED_OPTIONS and _NEGATIVE.match(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def _pose(text: str) -> Pose:
    words = text.split(",")
    try:
        x, y, theta = (float(word) for word in words)
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a pose: expected three numbers X,Y,THETA [m, m, rad], without blanks"
        ) from None
    if not all(abs(value) < float("inf") for value in (x, y, theta)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pose: every number must be finite")
    return x, y, theta


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of at least 0")
    return int(text)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def _map_file(text: str) -> Path:
    path = Path(text)
    if not path.is_file():
        raise argparse.ArgumentTypeError(f"{text}: no such file; give the YAML file of a ROS map")
    return path


def _navigation_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--map",
        type=_map_file,
        metavar="F.yaml",
        help="ROS map (default: the building that ships with unifg)",
    )
    parser.add_argument(
        "--start",
        type=_pose,
        metavar="X,Y,TH",
        help="start pose [m, m, rad]; has a default only for the shipped map",
    )
    parser.add_argument(
        "--goal",
        type=_pose,
        action="append",
        dest="goals",
        metavar="X,Y,TH",
        help="goal pose; repeat it for several goals, reached in this order",
    )
    parser.add_argument("--coupling", choices=COUPLINGS, default=COUPLINGS[0], help="of estimation and control")
    parser.add_argument(
        "--control-weight",
        type=_positive,
        default=1.0,
        metavar="W",
        help="factor on the costs of control, which pull on the estimate in the joint graph (default: 1)",
    )
    parser.add_argument(
        "--obstacles",
        type=_count,
        default=3,
        metavar="K",
        help="obstacles that are not on the map (default: 3)",
    )


def _run_navigation(chosen: argparse.Namespace, progress: Progress) -> Outcome:
    from unifg.scenarios import navigation  # imports the physics engine: not for --help
    from unifg.scenarios.driving.controller import ControllerSettings

    settings = navigation.NavigationSettings(
        map=chosen.map,
        start=chosen.start,
        goals=None if chosen.goals is None else tuple(chosen.goals),
        solver=chosen.solver,
        coupling=chosen.coupling,
        obstacles=chosen.obstacles,
        seed=chosen.seed,
        controller=ControllerSettings(control_weight=chosen.control_weight),
    )
    log = navigation.run_navigation(settings, progress=progress)
    if log.ticks == 0:
        raise KeyboardInterrupt
    return Outcome(log.succeeded, log.interrupted, summary(log), lambda folder: write_results(folder, log))


def _manoeuvres_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--case", choices=(*MANOEUVRES, "both"), default="both", help="which manoeuvre (default: %(default)s)"
    )


def _run_manoeuvres(chosen: argparse.Namespace, progress: Progress) -> Outcome:
    from unifg.answers.status import Status
    from unifg.scenarios import manoeuvres
    from unifg.scenarios.show import manoeuvre_plot as manoeuvre_plots

    names = MANOEUVRES if chosen.case == "both" else (chosen.case,)
    solved: list[manoeuvres.Manoeuvre] = []
    interrupted = False
    for number, name in enumerate(names):

        def tell(row: Iteration, name: str = name, number: int = number) -> None:
            share = 1.0 - 0.9**row.number  # nobody knows how many iterations there will be
            progress((number + share) / len(names), f"{name}: iteration {row.number}, cost {row.cost:.5g}")

        solved.append(manoeuvres.run_manoeuvre(manoeuvres.CASES[name], chosen.solver, progress=tell))
        interrupted = solved[-1].solution.status is Status.INTERRUPTED
        if interrupted:
            break
    progress(1.0, "solved")

    def write(folder: Path) -> list[Path]:
        numbers = manoeuvres.write_metrics(folder / "metrics.json", solved)
        return [*(manoeuvre_plots.write_picture(folder / f"{m.case.name}.png", m) for m in solved), numbers]

    return Outcome(all(m.succeeded for m in solved), interrupted, manoeuvres.table(solved), write)


def _run_velocity_tracking(chosen: argparse.Namespace, progress: Progress) -> Outcome:
    from unifg.answers.status import Status
    from unifg.scenarios import velocity_tracking
    from unifg.scenarios.show import velocity_plot as velocity_tracking_plots

    settings = velocity_tracking.TrackingSettings(
        chosen.length, chosen.solver, chosen.profile, chosen.linear, chosen.force_bounds, tolerance=chosen.tolerance
    )

    def tell(row: Iteration) -> None:
        progress(1.0 - 0.7**row.number, f"iteration {row.number}, cost {2.0 * row.cost:.8g}")

    drive = velocity_tracking.run_tracking(settings, progress=tell)
    progress(1.0, "solved")

    def write(folder: Path) -> list[Path]:
        picture = velocity_tracking_plots.write_picture(folder / "velocity_tracking.png", drive)
        return [picture, velocity_tracking.write_metrics(folder / "metrics.json", drive)]

    interrupted = drive.solution.status is Status.INTERRUPTED
    return Outcome(drive.succeeded, interrupted, velocity_tracking.table(drive), write)


def _run_solve(chosen: argparse.Namespace, progress: Progress) -> Outcome:
    from unifg.scenarios import pose_graph as solve
    from unifg.scenarios.commands import graph_results as solve_results

    settings = solve.SolveSettings(chosen.file, chosen.solver, chosen.robust, chosen.init, chosen.residual)
    solved = solve.solve_file(settings, progress)
    text = solve_results.summary(solved)
    return Outcome(
        solved.solution.converged, solved.interrupted, text, lambda f: solve_results.write_results(f, solved)
    )


SCENARIOS = {
    "navigation": Scenario(
        "A robot localises itself by lidar and drives through a building under MPC.",
        _navigation_arguments,
        _run_navigation,
    ),
    "manoeuvres": Scenario(
        "Two control graphs solved once: backing out of a wrong heading, and deflecting around an unforeseen disc.",
        _manoeuvres_arguments,
        _run_manoeuvres,
        random=False,
    ),
    "velocity-tracking": Scenario(
        velocity_tracking_arguments.DESCRIPTION,
        velocity_tracking_arguments.add_arguments,
        _run_velocity_tracking,
        random=False,
        solvers=names.EQUALITIES,
        solver="kkt",
    ),
    "quadrotor-mpc": Scenario(
        mpc_arguments.DESCRIPTION,
        mpc_arguments.add_arguments,
        mpc_arguments.run,
        solver="ipm",
    ),
    "quadrotor-obstacles": Scenario(
        obstacles_arguments.DESCRIPTION,
        obstacles_arguments.add_arguments,
        obstacles_arguments.run,
        random=False,  # its seed has no default: without one, the nominal layout
        solvers=names.SECOND_ORDER,
    ),
}
"""Everything ``unifg run`` can run."""


if __name__ == "__main__":
    sys.exit(main())
