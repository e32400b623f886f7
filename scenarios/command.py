"""The command ``unifg``: run a scenario, watch its progress, keep its results.

Exit status: 0 if the robot did what it was asked (every goal reached without a collision, every solve converged within
its limits), 1 if not, 2 for arguments that cannot be served, 130 after an interrupt (what was done until then is
written all the same); SIGTERM interrupts, too.

``unifg campaign`` runs many episodes (0 if every one of them succeeded), ``unifg report`` reports on them,
``unifg replay`` repeats one of them, ``unifg mcap`` writes a log for other tools. ``unifg doctor`` examines the
installation, ``unifg bench`` times it, ``unifg reproduce`` computes tables and figures of the papers again. What can be
run stands in `unifg.scenarios.commands.catalogue`; only the scenario that is named is loaded.
"""

from __future__ import annotations

import argparse
import io
import logging
import os
import re
import shlex
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

from unifg import __version__
from unifg.codegen import precompiled
from unifg.codegen.cache_folder import place
from unifg.codegen.threads import cores
from unifg.errors import FileFormatError, ScenarioError, UnifgError
from unifg.files.contents import legible
from unifg.scenarios.commands.catalogue import FROM_FILES, SCENARIOS
from unifg.scenarios.commands.extras import absent, remedy
from unifg.scenarios.commands.outcome import Outcome, Progress
from unifg.scenarios.options import Help, Unasked, count, existing, settings_of

__all__ = ["main"]

logger = logging.getLogger("unifg")

SUCCEEDED, FAILED, REFUSED, INTERRUPTED = 0, 1, 2, 130


@dataclass(frozen=True)
class Command:
    """Entry of `COMMANDS`.

    Attributes:
        does: takes what the parser found and returns the exit status.
        summary: a few words for the list of commands.
        about: a sentence for its own help.
        arguments: names and options of each, as for `argparse.ArgumentParser.add_argument`.
        exclusive: groups of arguments of which at most one may be given.
        extras: that it needs.
    """

    does: Callable[[argparse.Namespace], int]
    summary: str
    about: str
    arguments: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    exclusive: tuple[tuple[str, ...], ...] = ()
    extras: tuple[str, ...] = ()

    def add(self, parser: argparse.ArgumentParser) -> None:
        """Add the arguments."""
        groups = {
            name: group
            for names, group in ((names, parser.add_mutually_exclusive_group()) for names in self.exclusive)
            for name in names
        }
        for name, options in self.arguments.items():
            groups.get(name, parser).add_argument(name, **options)
        parser.set_defaults(does=self.does, extras=self.extras, parser=parser)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status.

    Args:
        argv: arguments without the program's name; None takes those of the process.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    _legible_streams()
    status = FAILED
    try:
        status = _served(arguments)
        if sys.stdout is not None:
            sys.stdout.flush()
    except OSError as error:
        if error.filename is None:  # of a stream, which Python would flush once more at the end
            with suppress(OSError, AttributeError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if not isinstance(error, BrokenPipeError):  # whose reader has had enough
            what = f"{error.filename}: cannot be read or written" if error.filename else "the output: cannot be written"
            return _refuse(f"{what} ({error.strerror})")
    return status


def _served(arguments: list[str]) -> int:
    """Serve the command line; the exit status."""
    try:
        chosen, unknown = _parser(arguments).parse_known_args(arguments)
        if unknown:
            chosen.parser.error(f"unrecognized arguments: {' '.join(unknown)}")
        if lacking := absent(*chosen.extras, *(["mcap"] if getattr(chosen, "mcap", False) else [])):
            return _refuse(str(remedy(lacking)))
        does: Callable[[argparse.Namespace], int] = chosen.does
        return does(chosen)
    except SystemExit as stop:  # argparse has said what is wrong, or has printed help
        return stop.code if isinstance(stop.code, int) else REFUSED
    except UnifgError as error:
        return _refuse(str(error))
    except ImportError as error:
        said = str(error) if isinstance(error.__cause__, ImportError) else remedy(error.name)
        if said is None:
            raise
        return _refuse(said)
    except KeyboardInterrupt as stop:
        print(f"unifg: interrupted{str(stop) or ' before there was anything to write'}", file=sys.stderr)
        return INTERRUPTED


def _legible_streams() -> None:
    """Let streams spell characters that their encoding lacks, and errors of a closed one go nowhere."""
    if sys.stderr is None:
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Parser of the command line; only the scenario named by the words has its options."""
    parser = _Parser(prog="unifg", description="Robot estimation and control as one factor graph.")
    parser.add_argument("--version", action="version", version=f"unifg {__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    run = commands.add_parser("run", help="run a scenario", description="Run a scenario.")
    scenarios = run.add_subparsers(title="scenarios", required=True, metavar="SCENARIO")
    for name, scenario in SCENARIOS.items():
        one = scenarios.add_parser(name, help=scenario.summary, description=scenario.summary, add_help=False)
        one.add_argument("-h", "--help", action=Help, first=scenario.first)
        one.set_defaults(name=name, does=_run, extras=("view",), parser=one)  # pictures are wanted at the end
        if list(words[:2]) == ["run", name]:
            scenario.add_options(one)
    for name, scenario in FROM_FILES.items():
        one = commands.add_parser(name, help=scenario.summary, description=scenario.summary)
        one.set_defaults(name=name, does=_run, extras=scenario.extras, parser=one)
        if list(words[:1]) == [name]:
            scenario.add_options(one)
    for name, entry in COMMANDS.items():
        entry.add(commands.add_parser(name, help=entry.summary, description=entry.about))
    return parser


def _campaign(chosen: argparse.Namespace) -> int:
    """Run what is missing of a campaign."""
    from unifg.scenarios.campaigns.campaign import run_campaign

    folder: Path = chosen.out or Path("out") / "campaigns" / chosen.file.stem
    with _progress_bar(chosen.file.stem, begun=True) as progress:
        found = run_campaign(
            chosen.file, folder, workers=chosen.workers, scheduler=chosen.scheduler, again=chosen.again,
            any_code=chosen.any_code, progress=progress,
        )  # fmt: skip
    for remark in found.remarks:
        print(f"note: {remark}")
    print(found.summary)
    print(f"report: {shlex.join(('unifg', 'report', str(folder)))}")
    if found.interrupted:
        return INTERRUPTED
    return SUCCEEDED if found.succeeded else FAILED


def _report(chosen: argparse.Namespace) -> int:
    """Write the report of a campaign."""
    from unifg.scenarios.campaigns.report import write_report

    for file in write_report(chosen.folder, chosen.against, chosen.any_code):
        print(file)
    return SUCCEEDED


def _replay(chosen: argparse.Namespace) -> int:
    """Run an episode of a campaign as ``unifg run`` would."""
    from unifg.scenarios.campaigns.replay import episode_of

    module, settings = episode_of(chosen.folder, chosen.key)
    chosen.out = chosen.out or chosen.folder / "replay" / chosen.key
    return _run_settings(chosen, module, settings, chosen.key)


def _mcap(chosen: argparse.Namespace) -> int:
    """Write the log of a drive or a flight for other tools."""
    from unifg.scenarios.logs.drive_log import EpisodeLog
    from unifg.scenarios.logs.flight_log import FlightLog
    from unifg.scenarios.logs.mcap_log import write_mcap

    stored: Path = chosen.folder
    if stored.is_dir():
        logs = [file for name in ("drive.npz", "flight.npz") if (file := stored / name).is_file()]
        if not logs:
            return _refuse(f"{legible(stored)}: holds neither drive.npz nor flight.npz; give {_LOG}")
        stored = max(logs, key=lambda file: file.stat().st_mtime)
    out: Path = chosen.out or stored.with_suffix(".mcap")
    kinds: list[type[EpisodeLog | FlightLog]] = [EpisodeLog, FlightLog]
    first, other = reversed(kinds) if stored.name == "flight.npz" else kinds  # a log may have been renamed
    try:
        log = first.load(stored)
    except FileFormatError as error:
        try:
            log = other.load(stored)
        except FileFormatError:
            raise error from None
    write_mcap(out, log)
    print(legible(out))
    return SUCCEEDED


def _check(chosen: argparse.Namespace) -> int:
    """Check a saved answer, and print the verdict with its reason."""
    from unifg.scenarios.commands.answers import load_graph
    from unifg.solution.saved import check_answer

    found = check_answer(load_graph(chosen.graph), chosen.answer, chosen.tolerance)
    print(found)
    return SUCCEEDED if found else FAILED


def _warm_up(chosen: argparse.Namespace) -> int:
    """Compile everything, and print how much there was to do."""
    from unifg.scenarios.commands import warm

    if chosen.check:
        if changed := precompiled.outdated():
            print("out of date: " + ", ".join(changed) + "; write it anew with `unifg warmup --ship`")
        return FAILED if changed else SUCCEEDED
    began = time.perf_counter()
    with _progress_bar("warmup") as progress:
        if chosen.ship:
            archive = warm.ship(progress)
            print(f"{archive}: {archive.stat().st_size / 1e6:.1f} MB")
            return SUCCEEDED
        done = warm.run(progress, processes=cores())
    parts = (len(done.compiled), "compiled"), (len(done.generated), "generated"), (len(done.read), "read")
    text = ", ".join(f"{count} functions {what}" for count, what in parts if count)
    print(f"{text or 'everything is there: found'} in {time.perf_counter() - began:.1f} s")
    if lacking := warm.missing():
        print(f"scenarios are left out, they need {lacking}: pip install 'unifg[scenarios]'")
    return SUCCEEDED


def _cache(chosen: argparse.Namespace) -> int:
    """Name the folder of what is compiled, or delete it."""
    folder = place()
    if chosen.clear:
        try:
            shutil.rmtree(folder)
        except FileNotFoundError:  # there is none, or another process deletes it
            pass
        except OSError as error:
            return _refuse(f"{folder}: cannot be deleted ({error.strerror}: {error.filename})")
    print(folder)
    return SUCCEEDED


def _doctor(chosen: argparse.Namespace) -> int:
    """Examine the installation."""
    from unifg.scenarios.commands import doctor

    with _progress_bar("doctor") as progress:
        findings = list(doctor.examined(progress))
    print(doctor.report(findings))
    return FAILED if any(finding.good is False for finding in findings) else SUCCEEDED


def _convert(chosen: argparse.Namespace) -> int:
    """Write a file in another format."""
    from unifg.scenarios.commands.convert import convert

    print(f"{chosen.target}: {convert(chosen.source, chosen.target)}")
    return SUCCEEDED


def _bench(chosen: argparse.Namespace) -> int:
    """Time everything and compare it."""
    from unifg.scenarios.commands import performance

    records = performance.history(chosen.against or performance.HISTORY)
    if chosen.record is not None:
        chosen.record.open("a").close()  # better refused now than after the measurement
    with _progress_bar("bench") as progress:
        now = performance.measured(performance.QUICK if chosen.quick else performance.LONG, progress)
    alike = performance.last(records, now.machine)
    then = alike or performance.last(records)
    rows = performance.compared(now, then) if then is not None else {}
    print(performance.report(now, rows))
    if then is not None:
        other = "" if alike else f"; another machine ({then.machine}), so factors mean little"
        print(f"\nmachine: {now.machine}\nrecord: unifg {then.version}, {then.when}{other}")
    if chosen.record is not None:
        performance.append(chosen.record, now)
    slower = [name for name, row in rows.items() if row.slower] if alike else []
    if slower:
        print(f"slower by more than {100 * (performance.SLOWER - 1):.0f} %: {', '.join(slower)}")
    return FAILED if slower and chosen.strict else SUCCEEDED


def _reproduce(chosen: argparse.Namespace) -> int:
    """List tables and figures of the papers, or compute one again beside what is printed."""
    from unifg.scenarios.papers import catalogue
    from unifg.scenarios.papers.comparison import Effort

    asked = [(kind, number) for kind in ("table", "figure") if (number := getattr(chosen, kind)) is not None]
    if chosen.paper is None or not asked:
        if asked:
            chosen.parser.error(f"name the paper of --{asked[0][0]} {asked[0][1]}: {', '.join(catalogue.PAPERS)}")
        print(catalogue.listed(chosen.paper))
        return SUCCEEDED
    (kind, number), *_ = asked
    compute = catalogue.found(chosen.paper, kind, number)
    with _progress_bar(f"{chosen.paper} {kind} {number}") as progress:
        print(compute(Effort(not chosen.full, chosen.out, chosen.workers, progress)))
    return SUCCEEDED


def _run(chosen: argparse.Namespace) -> int:
    """Run the chosen scenario, write what it left and say how it went."""
    solver = {"solver": chosen.solver} if hasattr(chosen, "solver") else {}
    settings = settings_of(chosen.module.SETTINGS, chosen, **solver)
    if chosen.stated:
        from unifg.scenarios.campaigns.stated_settings import Fields

        asked = {name for name, value in vars(chosen).items() if not isinstance(value, Unasked)}
        settings = Fields(chosen.module.SETTINGS, Path.cwd()).restated(settings, chosen.stated, asked)
    return _run_settings(chosen, chosen.module, settings, chosen.name)


def _run_settings(chosen: argparse.Namespace, module: Any, settings: Any, name: str) -> int:
    """The same for settings that are known."""
    folder: Path = chosen.out
    try:
        folder.mkdir(parents=True, exist_ok=True)  # better refused now than after the run
    except OSError as error:
        return _refuse(f"--out {folder}: cannot make this folder ({error.strerror})")
    if not os.access(folder, os.W_OK | os.X_OK):
        return _refuse(f"--out {folder}: cannot write to this folder")
    reused = (folder / "metrics.json").is_file()
    with _interrupts() as told:
        watched = {"announce": _announce} if getattr(chosen, "live", False) else {}
        with _bar(name) as show:
            show(0.0, "preparing")
            try:
                outcome: Outcome = module.run(settings, told(show), **watched)
            except (OSError, SystemExit) as error:  # of what a run reads, or of a user's part: nothing is written yet
                raise ScenarioError(f"{name}: {type(error).__name__}: {error}") from error
        if getattr(chosen, "mcap", False):
            outcome.record()
        try:
            # each file is written whole, also after a signal
            with _bar("writing", interval=0.0) as show:
                files = outcome.write(folder, show)
        except OSError as error:
            return _refuse(f"--out {folder}: cannot write the results ({error})")
        except KeyboardInterrupt:
            print(f"unifg: interrupted while {folder} was written; each file there is whole", file=sys.stderr)
            return INTERRUPTED
    print(outcome.summary)
    print()
    for file in files:
        print(legible(file))
    others = sorted(legible(file.name) for file in {*folder.iterdir()} - {*files} if file.is_file())
    if reused and others:
        named = f"{legible(folder)} holds files that this run has not written: {', '.join(others)}"
        print(f"unifg: note: {named}", file=sys.stderr)
    if outcome.error is not None:
        logger.error("%s was ended before its end", name, exc_info=outcome.error)
        return FAILED
    if outcome.interrupted:
        return INTERRUPTED
    return SUCCEEDED if outcome.succeeded else FAILED


@contextmanager
def _progress_bar(name: str, begun: bool = False) -> Iterator[Progress]:
    """A bar whose run may be interrupted, see :func:`_interrupts`."""
    with _interrupts(begun) as told, _bar(name) as show:
        yield told(show)


@contextmanager
def _interrupts(begun: bool = False) -> Iterator[Callable[[Progress], Progress]]:
    """The first control-C or SIGTERM waits for the end of a tick, so that the record stays whole.

    Before the first tick there is no record, and nothing to wait for; after the last one the results are written first.

    Args:
        begun: whether there is something to keep from the beginning.

    Yields:
        Maker of a progress that ends the run after a signal, from one that shows it.
    """
    wanted = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal wanted
        at_once = wanted or not begun  # it does not come to an end, or has nothing to keep
        wanted = True  # also where a finaliser swallows the exception: the first tick is then the last
        if at_once:
            raise KeyboardInterrupt

    def told(show: Progress) -> Progress:
        def progress(done: float, text: str) -> None:
            nonlocal wanted, begun
            show(done, text)
            begun = True
            if wanted and done < 1.0:
                wanted = False
                raise KeyboardInterrupt

        return progress

    try:
        before = [(stop, signal.signal(stop, interrupt)) for stop in (signal.SIGINT, signal.SIGTERM)]
    except ValueError:  # not in the main thread, where no interrupt arrives either
        yield told
        return
    try:
        yield told
    finally:
        for stop, handler in before:
            signal.signal(stop, handler)


@contextmanager
def _bar(name: str, interval: float = 0.1) -> Iterator[Progress]:
    """Progress bar on a terminal; elsewhere, and where tqdm is not installed, one line at the end.

    Args:
        name: beside the bar.
        interval: least time between two changes of it [s].
    """
    if not sys.stderr.isatty() or find_spec("tqdm") is None:
        began = time.monotonic()
        yield lambda done, text: None
        print(f"{name}: done in {time.monotonic() - began:.1f} s", file=sys.stderr)
        return
    from tqdm import tqdm

    layout = "{desc} {percentage:3.0f}%|{bar}| {elapsed} {postfix}"
    settings = {"bar_format": layout, "mininterval": interval, "miniters": 0.0}
    with tqdm(total=1.0, desc=name, file=sys.stderr, **settings) as bar:

        def show(done: float, text: str) -> None:
            bar.set_postfix_str(text, refresh=False)
            bar.update(max(0.0, min(done, 1.0) - bar.n))

        yield show


def _announce(url: str) -> None:
    """Say where a run can be watched."""
    print(f"\nlive: {url}", file=sys.stderr, flush=True)


def _refuse(message: str) -> int:
    print(f"unifg: error: {message}", file=sys.stderr)
    return REFUSED


class _Parser(argparse.ArgumentParser):
    """Parser that takes ``-2,-0.5,0`` for a value, as the standard one takes ``-2``; an error takes two lines."""

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
        self._negative_number_matcher = re.compile(r"-[\d.]")

    def error(self, message: str) -> NoReturn:
        """Report an error first, then the usage without the options, in a line."""
        usage = re.sub(r"\[.*\]", "[options]", " ".join(self.format_usage().split()))
        self.exit(REFUSED, f"{self.prog}: error: {message}\n{usage} (options: {self.prog} --help)\n")


_ANY_CODE = {"action": "store_true", "help": "episodes that other states of the code have run count, too"}
_WORKERS = {
    "type": partial(count, least=1), "default": 1, "metavar": "N", "help": "processes, one thread each (default: 1)",
}  # fmt: skip
_LOG = "the results of unifg run navigation or quadrotor-mpc, or a log of theirs"
_LIVE = {"action": "store_true", "help": "show it in a browser while it runs; says where"}

COMMANDS = {
    "warmup": Command(
        _warm_up, "compile everything beforehand",
        "Compile, once for all programs to come, what the library and its scenarios can reach.",
        {
            "--ship": {"action": "store_true", "help": "write the half compiled kernels that come with unifg anew"},
            "--check": {"action": "store_true", "help": "list those that are out of date; compile nothing"},
        },
        (("--ship", "--check"),),
    ),
    "cache": Command(
        _cache, "name or delete what is kept of compiled functions",
        "Name the folder that keeps compiled functions from one process to the next.",
        {
            "--where": {"action": "store_true", "help": "print the folder (the default)"},
            "--clear": {"action": "store_true", "help": "delete it: what is needed is generated or compiled anew"},
        },
        (("--where", "--clear"),),
    ),
    "doctor": Command(
        _doctor, "examine the installation",
        "Examine the installation: versions, caches, threads, every backend on a problem with a known answer.",
    ),
    "bench": Command(
        _bench, "measure the speed on this machine",
        "Time what the library does beside a reference, and compare the ratios with a record.",
        {
            "--quick": {"action": "store_true", "help": "fewer rounds: less than a minute"},
            "--against": {"type": Path, "metavar": "FILE", "help": "records to compare with (default: those of unifg)"},
            "--record": {"type": Path, "metavar": "FILE", "help": "append what is measured to this file"},
            "--strict": {"action": "store_true", "help": "fail if a case is slower than its last record"},
        },
    ),
    "campaign": Command(
        _campaign, "run many episodes",
        "Run every episode of a campaign that is not on file: a scenario, settings, seeds, as a TOML file states them.",
        {
            "file": {"type": Path, "metavar": "FILE.toml", "help": "what to run"},
            "--out": {"type": Path, "metavar": "DIR", "help": "folder for results (default: out/campaigns/FILE)"},
            "--workers": _WORKERS,
            "--scheduler": {
                "metavar": "ADDRESS", "help": "of a dask.distributed cluster, such as tcp://10.0.0.1:8786",
            },
            "--again": {"action": "store_true", "help": "repeat episodes that ended in an error or were lost"},
            "--any-code": {"action": "store_true", "help": "keep episodes that other states of the code have run"},
        },
        (("--workers", "--scheduler"),),
    ),
    "reproduce": Command(
        _reproduce, "compute tables and figures of the papers again",
        "Compute a table or figure of one of the four papers again, and print it beside the printed numbers: paper, "
        "ours, difference, interval. Without arguments, list them.",
        {
            "paper": {"nargs": "?", "metavar": "PAPER", "help": "bazzana, ta, factormpc or ecg2o"},
            "--table": {"metavar": "N", "help": "table, as the paper numbers it"},
            "--figure": {"metavar": "N", "help": "figure, as the paper numbers it"},
            "--quick": {"action": "store_true", "help": "a few runs, within five minutes (the default)"},
            "--full": {"action": "store_true", "help": "as many runs as on the page of results"},
            "--workers": _WORKERS,
            "--out": {
                "type": Path, "default": Path("out") / "reproduce", "metavar": "DIR",
                "help": "folder for drives, which are not repeated (default: %(default)s)",
            },
        },
        (("--table", "--figure"), ("--quick", "--full")),
    ),
    "report": Command(
        _report, "report on a campaign",
        "Write tables and pictures of a campaign, finished or not, as report.html and report.md in its folder.",
        {
            "folder": {"type": Path, "metavar": "DIR", "help": "of the campaign"},
            "--against": {
                "type": Path, "metavar": "DIR2", "help": "compare with the same episodes of another campaign",
            },
            "--any-code": _ANY_CODE,
        },
    ),
    "convert": Command(
        _convert, "a pose graph or trajectory in another format",
        "Read g2o, TORO, GTSAM, TUM (.tum), KITTI (.kitti) or EuRoC (.csv); write g2o, TORO, TUM or KITTI.",
        {
            "source": {"type": Path, "metavar": "FILE", "help": "to read, gzipped or not"},
            "target": {"type": Path, "metavar": "FILE2", "help": "to write: .g2o, .graph, .tum, .kitti, also .gz"},
        },
    ),
    "replay": Command(
        _replay, "repeat an episode", "Run one episode of a campaign again, with scene, pictures and metrics.",
        {
            "folder": {"type": Path, "metavar": "DIR", "help": "of the campaign"},
            "key": {"metavar": "KEY", "help": "of the episode, as the report names it"},
            "--out": {"type": Path, "metavar": "DIR2", "help": "folder for results (default: DIR/replay/KEY)"},
            "--live": _LIVE,
        },
        extras=("view",),
    ),
    "check": Command(
        _check, "check a saved answer",
        "Check an answer that solution.save wrote by the functions of its graph, independently of any solver.",
        {
            "graph": {"metavar": "SCRIPT.py:GRAPH", "help": "a graph, or a function that returns it; or MODULE:GRAPH"},
            "answer": {"type": Path, "metavar": "FILE.npz", "help": "values, multipliers, cost and data"},
            "--tolerance": {
                "type": float, "default": 1e-6, "help": "of violation and KKT numbers (default: %(default)s)",
            },
        },
    ),
    "mcap": Command(
        _mcap, "export a drive or a flight",
        "Write a log, drive.npz or flight.npz, as messages that Foxglove, PlotJuggler and mcap's tools play.",
        {
            "folder": {
                "type": existing(_LOG, folders=True), "metavar": "DIR",
                "help": "results of unifg run, its latest log, or a log itself",
            },
            "--out": {"type": Path, "metavar": "FILE", "help": "to write (default: beside the log)"},
        },
    ),
}  # fmt: skip
"""Everything beside ``unifg run`` and ``unifg solve``."""


if __name__ == "__main__":
    sys.exit(main())
