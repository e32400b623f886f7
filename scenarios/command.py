"""The command ``unifg``: run a scenario, watch its progress, keep its results.

Exit status: 0 if the robot did what it was asked (every goal reached without a collision, every solve converged within
its limits), 1 if not, 2 for arguments that cannot be served, 130 after an interrupt (what was done until then is
written all the same).

What can be run stands in `unifg.scenarios.commands.catalogue`; only the scenario that is named is loaded.
"""

from __future__ import annotations

import argparse
import re
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import FrameType

from unifg import __version__
from unifg.errors import UnifgError
from unifg.scenarios.commands.catalogue import SCENARIOS, SOLVE
from unifg.scenarios.commands.outcome import Outcome, Progress
from unifg.scenarios.options import settings_of

__all__ = ["main"]

SUCCEEDED, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130

_PAIRED_OPTIONS = ("--start", "--goal", "--force-bounds")
_NEGATIVE = re.compile(r"-[\d.]")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: arguments without the program's name; None takes those of the process.
    """
    arguments = _join_negative(list(sys.argv[1:] if argv is None else argv))
    try:
        chosen = _parser(arguments).parse_args(arguments)
    except ModuleNotFoundError as error:  # of the scenario that is named
        return _refuse(f"scenarios need {error.name}: pip install 'unifg[scenarios]'")
    except SystemExit as stop:  # argparse has said what is wrong, or has printed help
        return stop.code if isinstance(stop.code, int) else REFUSED
    try:
        return _warm_up(chosen) if chosen.name == "warmup" else _run(chosen)
    except UnifgError as error:
        return _refuse(str(error))
    except KeyboardInterrupt:
        print("unifg: interrupted before there was anything to write", file=sys.stderr)
        return INTERRUPTED


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of the command line; only the scenario named by the words has its options."""
    parser = argparse.ArgumentParser(
        prog="unifg", description="Robot estimation and control as one factor graph.", allow_abbrev=False
    )
    parser.add_argument("--version", action="version", version=f"unifg {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="run a scenario", description="Run a scenario.", allow_abbrev=False)
    scenarios = run.add_subparsers(title="scenarios", required=True, metavar="SCENARIO")
    for name, scenario in SCENARIOS.items():
        one = scenarios.add_parser(name, help=scenario.summary, description=scenario.summary, allow_abbrev=False)
        one.set_defaults(name=name)
        if list(words[:2]) == ["run", name]:
            scenario.add_options(one)
    solve = commands.add_parser("solve", help="solve a pose graph", description=SOLVE.summary, allow_abbrev=False)
    solve.set_defaults(name="solve")
    if list(words[:1]) == ["solve"]:
        SOLVE.add_options(solve)
    about = "Compile, once for all programs to come, what the library and its scenarios can reach."
    warm = commands.add_parser("warmup", help="compile everything beforehand", description=about, allow_abbrev=False)
    warm.set_defaults(name="warmup")
    other = warm.add_mutually_exclusive_group()
    other.add_argument("--ship", action="store_true", help="write the half compiled kernels that come with unifg anew")
    other.add_argument("--check", action="store_true", help="say whether these are out of date; compile nothing")
    if list(words[:1]) == ["warmup"]:
        warm.set_defaults(module=import_module("unifg.scenarios.commands.warm"))
    return parser


def _warm_up(chosen: argparse.Namespace) -> int:
    """Compile everything, and say how much there was to do."""
    if chosen.check:
        changed = chosen.module.outdated()
        if changed:
            print("out of date: " + ", ".join(changed) + "; write it anew with `unifg warmup --ship`")
        return FAILED if changed else SUCCEEDED
    began = time.perf_counter()
    with _progress_bar("warmup") as progress:
        done = chosen.module.ship(progress) if chosen.ship else chosen.module.run(progress)
    if chosen.ship:
        print(f"{done}: {done.stat().st_size / 1e6:.1f} MB")
    else:
        parts = (len(done.compiled), "compiled"), (len(done.generated), "generated"), (len(done.read), "read")
        text = ", ".join(f"{count} functions {what}" for count, what in parts if count)
        print(f"{text or 'everything is there: found'} in {time.perf_counter() - began:.1f} s")
    return SUCCEEDED


def _run(chosen: argparse.Namespace) -> int:
    """Run the chosen scenario, write what it left and say how it went."""
    folder: Path = chosen.out
    try:
        folder.mkdir(parents=True, exist_ok=True)  # better refused now than after the run
    except OSError as error:
        return _refuse(f"--out {folder}: cannot make this folder ({error.strerror})")
    settings = settings_of(chosen.module.SETTINGS, chosen, solver=chosen.solver)
    with _progress_bar(chosen.name) as progress:
        watched = {"announce": _announce} if getattr(chosen, "live", False) else {}
        outcome: Outcome = chosen.module.run(settings, progress, **watched)
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


def _announce(url: str) -> None:
    """Say where a run can be watched."""
    print(f"\nlive: {url}", file=sys.stderr, flush=True)


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


if __name__ == "__main__":
    sys.exit(main())
