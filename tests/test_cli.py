"""The command line: arguments, exit status, files, without driving a real episode."""

import argparse
import contextlib
import json
import os
import re
import signal
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from episodes import episode, room
from fences import fences
from scripts import CHECKOUT, run_script
from unifg import __version__
from unifg.errors import ScenarioError
from unifg.files.g2o import write_g2o
from unifg.files.ros_map import save_map
from unifg.files.tum import read_tum
from unifg.pose_graphs.generate import manhattan
from unifg.scenarios import command
from unifg.scenarios import navigation as navigation_scenario
from unifg.scenarios.commands import drives
from unifg.scenarios.commands.catalogue import SCENARIOS
from unifg.scenarios.commands.outcome import Writer
from unifg.scenarios.episode import run_ticks
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.logs.drive_log import EpisodeLog
from unifg.scenarios.logs.metrics import write_metrics
from unifg.scenarios.navigation import NavigationSettings
from unifg.scenarios.options import add_options, option, pose, positive, settings_of

FILES = ("scene.html", "overview.png", "metrics.json", "trajectory.tum", "estimate.tum", "drive.npz")

Progress = Callable[[float, str], None]


class FakeNavigation:
    """Stands in for the scenario: notes the settings, reports progress, gives a made-up episode."""

    def __init__(self) -> None:
        self.settings: list[NavigationSettings] = []
        self.log = episode(ticks=5)

    def run(self, settings: NavigationSettings, progress: Progress) -> EpisodeLog:
        self.settings.append(settings)
        progress(0.5, "halfway")
        progress(1.0, "done")
        return self.log


@pytest.fixture
def navigation(monkeypatch: pytest.MonkeyPatch) -> FakeNavigation:
    fake = FakeNavigation()
    monkeypatch.setattr(navigation_scenario, "run_navigation", fake.run)
    return fake


def touched(log: EpisodeLog) -> dict[str, Writer]:
    """Stand in for results, whose pictures take a second."""
    return {name: Path.touch for name in FILES}


@pytest.fixture
def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spare tests that look at settings and ends alone the drawing of pictures."""
    monkeypatch.setattr(drives, "results", touched)


def run(tmp_path: Path, *words: str) -> int:
    return command.main(["run", "navigation", *words, "--out", str(tmp_path / "out")])


@pytest.mark.product(1, of="scenes and pictures")
def test_writes_every_file_and_names_it(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path) == 0
    said = capsys.readouterr()
    for name in FILES:
        file = tmp_path / "out" / name
        assert file.stat().st_size > 0
        assert str(file) in said.out.splitlines()
    for words in ("goals reached", "1 of 1", "collisions", "localisation error", "median"):
        assert words in said.out
    assert re.fullmatch(r"navigation: done in [\d.]+ s\nwriting: done in [\d.]+ s\n", said.err)
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["steps"] == 5
    truth, estimate = (read_tum(tmp_path / "out" / name).planar() for name in FILES if name.endswith(".tum"))
    np.testing.assert_allclose(truth, navigation.log.true_pose, atol=1e-8)
    np.testing.assert_allclose(estimate, navigation.log.estimate, atol=1e-8)


@pytest.mark.usefixtures("navigation", "no_files")
def test_a_folder_used_again_is_told_what_is_not_of_this_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    assert run(tmp_path) == 0
    assert "note" not in capsys.readouterr().err  # nothing of an earlier run is there
    (tmp_path / "out" / "flight.npz").touch()
    assert run(tmp_path) == 0
    assert "out holds files that this run has not written: flight.npz, thesis.tex\n" in capsys.readouterr().err
    assert (tmp_path / "out" / "thesis.tex").exists()


@pytest.mark.usefixtures("no_files")
def test_bars_are_drawn_on_a_terminal(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    assert run(tmp_path) == 0
    said = capsys.readouterr()
    assert re.search(r"navigation 100%\|.*done", said.err) and "100%" not in said.out
    assert "overview.png" in said.err and re.search(r"writing 100%\|.*done", said.err)


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("", NavigationSettings(obstacles=3)),
        (
            "--map m.yaml --start=0,0,0 --goal=1,2,0.5 --goal 2,1e0,-3 --solver alm --obstacles 4 --seed 17",
            NavigationSettings(
                Path("m.yaml"), (0.0, 0.0, 0.0), ((1.0, 2.0, 0.5), (2.0, 1.0, -3.0)), "alm", "sequential", 4, seed=17
            ),
        ),
        (
            "--coupling joint --control-weight 0.1",
            NavigationSettings(
                obstacles=3, coupling="joint", controller=replace(ControllerSettings(), control_weight=0.1)
            ),
        ),
    ],
    ids=["none", "many", "of the controller"],
)
def test_arguments_arrive(
    navigation: FakeNavigation,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    words: str,
    expected: NavigationSettings,
) -> None:
    monkeypatch.chdir(tmp_path)
    save_map(tmp_path / "m.yaml", room())
    assert run(tmp_path, *words.split()) == 0
    assert navigation.settings == [expected]


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize("value", ["-2,-0.5,0", "-.5,1,0", "-2e0,3,-1"])
def test_values_that_begin_with_a_minus(navigation: FakeNavigation, tmp_path: Path, value: str) -> None:
    pose = tuple(float(word) for word in value.split(","))
    for form in (["--start", value, "--goal", value], [f"--start={value}", f"--goal={value}"]):
        assert run(tmp_path, *form) == 0
        assert navigation.settings[-1].start == pose
        assert navigation.settings[-1].goals == (pose,)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--start", "1,2"], r"argument --start: '1,2' is not a pose: expected three numbers"),
        (["--start", "-1,2"], r"argument --start: '-1,2' is not a pose"),
        (["--goal", "1,2,3,4"], r"argument --goal: '1,2,3,4' is not a pose"),
        (["--goal", "1,two,3"], r"'1,two,3' is not a pose"),
        (["--goal", "1,nan,3"], r"every number must be finite"),
        (["--start", "--goal", "1,2,3"], r"argument --start: expected one argument"),
        (["--solver", "ipopt"], r"invalid choice: 'ipopt' \(choose from '?kkt'?, '?penalty'?, .*'?ipm'?\)"),
        (["--coupling", "magic"], r"choose from '?sequential'?"),
        (["--obstacles", "-1"], r"argument --obstacles"),
        (["--obstacles", "many"], r"'many' is not a whole number"),
        (["--seed", "1.5"], r"'1\.5' is not a whole number"),
        (["--map", "nowhere.yaml"], r"nowhere\.yaml: no such file"),
        (["--sol", "alm"], r"unrecognized arguments: --sol"),
        *(([f"--control-weight={weight}"], r"positive") for weight in ("0", "-1", "nan", "much")),
    ],
)
def test_bad_arguments_exit_2(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert run(tmp_path, *words) == 2
    error, usage = capsys.readouterr().err.splitlines()
    assert re.search(rf"^unifg run navigation: error: .*{message}", error)
    assert usage == "usage: unifg run navigation [options] (options: unifg run navigation --help)"
    assert navigation.settings == []


@pytest.mark.parametrize("words", [[], ["run"], ["run", "swimming"], ["fly"]])
def test_unknown_commands_exit_2(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(words) == 2
    assert "usage: unifg" in capsys.readouterr().err


def test_help_and_version_exit_0(capsys: pytest.CaptureFixture[str]) -> None:
    assert command.main(["--version"]) == 0
    assert capsys.readouterr().out == f"unifg {__version__}\n"
    for words in command.COMMANDS:
        assert command.main([words, "--help"]) == 0
        assert f"usage: unifg {words}" in capsys.readouterr().out
    assert command.main(["run", "navigation", "--help", "all"]) == 0
    said = capsys.readouterr().out
    for flag in ("--map", "--start", "--goal", "--solver", "--coupling", "--obstacles", "--seed", "--out"):
        assert flag in said


def test_scenario_error_is_a_message_not_a_traceback(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(settings: NavigationSettings, progress: Progress) -> EpisodeLog:
        raise ScenarioError("goal 1 stands in a wall")

    monkeypatch.setattr(navigation_scenario, "run_navigation", refuse)
    assert run(tmp_path) == 2
    said = capsys.readouterr()
    assert said.err.splitlines()[-1] == "unifg: error: goal 1 stands in a wall"
    assert "Traceback" not in said.err and said.out == ""


def test_broken_map_is_a_message(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "m.yaml").write_text("image: gone.pgm\nresolution: 0.1\norigin: [0, 0, 0]\n")
    # The real scenario, which must not get further than the map.
    assert run(tmp_path, "--map", str(tmp_path / "m.yaml"), "--start=0,0,0", "--goal=1,0,0") == 2
    assert "gone.pgm" in capsys.readouterr().err.splitlines()[-1]


def test_out_that_cannot_be_written_is_refused_before_the_run(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "out").write_text("in the way")
    assert run(tmp_path) == 2
    assert "cannot make this folder" in capsys.readouterr().err
    (tmp_path / "out").unlink()
    monkeypatch.setattr(os, "access", lambda path, mode: False)  # chmod would not stop root
    assert run(tmp_path) == 2
    assert "cannot write to this folder" in capsys.readouterr().err
    assert navigation.settings == []


@pytest.mark.usefixtures("no_files")
@pytest.mark.parametrize(
    ("changes", "status"),
    [({"collisions": 1}, 1), ({"reached": [False]}, 1), ({"interrupted": True}, 130)],
)
def test_exit_status_tells_the_outcome(
    navigation: FakeNavigation, tmp_path: Path, changes: dict[str, object], status: int
) -> None:
    navigation.log = replace(navigation.log, **changes)  # type: ignore[arg-type]
    assert run(tmp_path) == status
    assert all((tmp_path / "out" / name).exists() for name in FILES)


def test_interrupt_before_the_first_tick(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(settings: NavigationSettings, progress: Progress) -> EpisodeLog:
        raise KeyboardInterrupt

    monkeypatch.setattr(navigation_scenario, "run_navigation", stop)
    assert run(tmp_path) == 130
    assert "before there was anything to write" in capsys.readouterr().err
    assert list((tmp_path / "out").iterdir()) == []


@pytest.mark.skipif(os.name == "nt", reason="signals work otherwise on Windows")
@pytest.mark.parametrize(
    ("when", "status", "count"),
    [("before", 130, 0), ("swallowed", 130, 1), ("a tick", 130, 3), ("last tick", 0, 5), ("while writing", 0, 5)],
)
def test_an_end_asked_for_at_any_moment_loses_nothing(
    when: str, status: int, count: int, navigation: FakeNavigation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before the first tick it ends at once, later after the tick; what was run to its end is written whole.

    Python prints and drops what is raised in finalisers, also the interrupt; the first tick is then the last.
    """
    ticks: list[int] = []

    def ask(moment: str) -> None:
        if when == moment:
            os.kill(os.getpid(), signal.SIGTERM)

    def loop(settings: NavigationSettings, progress: Progress) -> EpisodeLog:
        def tick(number: int) -> tuple[float, str] | None:
            ask({2: "a tick", 4: "last tick"}.get(number, ""))
            ticks.append(number)  # reached although the signal came first
            return None if number == 4 else (number / 5, "driving")

        ask("before")
        with contextlib.suppress(KeyboardInterrupt):  # as a finaliser does
            ask("swallowed")
        return replace(navigation.log, interrupted=run_ticks(10, tick, progress))

    def results(log: EpisodeLog) -> dict[str, Writer]:
        return {"note": lambda path: ask("while writing"), **touched(log)}

    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(navigation_scenario, "run_navigation", loop)
    monkeypatch.setattr(drives, "results", results)
    assert run(tmp_path) == status
    assert len(ticks) == count
    assert (tmp_path / "out" / "scene.html").exists() is (when != "before")
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.skipif(os.name == "nt", reason="signals work otherwise on Windows")
def test_a_user_who_does_not_wait_for_the_results_is_told_what_there_is(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second signal while results are written ends it there; what had been written stays."""
    written = write_metrics

    def impatient(path: Path, numbers: dict[str, object]) -> Path:
        done = written(path, numbers)
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGTERM)
        return done

    monkeypatch.setattr(drives, "write_metrics", impatient)
    monkeypatch.setattr(
        navigation_scenario, "run_navigation", lambda settings, progress: told(navigation.log, progress)
    )
    assert run(tmp_path) == 130
    assert f"interrupted while {tmp_path / 'out'} was written" in capsys.readouterr().err
    assert [file.name for file in (tmp_path / "out").iterdir()] == ["metrics.json"]


def told(log: EpisodeLog, progress: Progress) -> EpisodeLog:
    """An episode that says that it is done."""
    progress(1.0, "there")
    return log


DRAWING = {"meshcat", "matplotlib"}
DRIVING = {"pymunk", "unifg.scenarios.navigation"}
SOLVING = {"scipy.special", "scipy.ndimage", "scipy.sparse", "scipy.linalg", "osqp", "piqp", "qpsolvers"}
ABSENT = [  # in one process, from what needs least to what needs most
    (["--help"], DRAWING | DRIVING | {"unifg.solvers"}),
    (["run", "--help"], DRAWING | DRIVING | {"unifg.solvers"}),
    (["solve", "--help"], DRAWING | DRIVING | SOLVING),
    (["run", "navigation", "--help"], DRAWING | {"unifg.scenarios.flight"}),
]


@pytest.mark.product(2, of="processes of their own")
def test_help_loads_the_scenario_it_speaks_of_and_no_other(tmp_path: Path) -> None:
    """Nor does solving a map load SciPy or what draws, once it is compiled: a compiler loads `scipy.linalg`."""
    file = str(write_g2o(tmp_path / "map.g2o", manhattan(60).pose_graph))
    solve = ["solve", file, "--out", f"{file}.out"]
    run_script(f"from unifg.scenarios import command\nassert command.main({solve!r}) == 0")
    code = (
        "import sys\nfrom unifg.scenarios import command\n"
        f"for words, absent in {[*ABSENT[:3], (solve, ABSENT[2][1]), ABSENT[3]]!r}:\n"
        "    assert command.main(words) == 0\n"
        "    assert not absent & {*sys.modules}, (words, absent & {*sys.modules})"
    )
    done = run_script(code)
    assert re.sub(r"(solve|writing): done in .* s\n", "", done.stderr) == ""
    for words, _ in ABSENT:
        assert f"usage: unifg {' '.join(words[:-1])}".rstrip() in done.stdout


BARE = """
import contextlib, io, json, sys
for name in ("matplotlib", "mcap", "meshcat", "pandas", "PIL", "pymunk", "tqdm", "yaml", "distributed"):
    sys.modules[name] = None
from unifg.scenarios.command import main
example, *commands = sys.argv[1:]
exec(example, {})
for words in commands:
    with contextlib.redirect_stderr(io.StringIO()) as said, contextlib.redirect_stdout(io.StringIO()):
        status = main(words.split())
    print(json.dumps([words, status, said.getvalue()]))
"""


@pytest.mark.product(2, of="processes of their own")
def test_without_extras_everything_works_or_names_the_extra(tmp_path: Path) -> None:
    """Plain ``pip install .``: README's first example, every help, and every command."""
    (tmp_path / "p.g2o").write_text("EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 1 0 1 1 0 0 1 0 1\n")
    (tmp_path / "drives.toml").write_text('scenario = "navigation"\nseeds = 1\n')
    episode(ticks=2).save(tmp_path / "drive.npz")
    works = ["--help", "solve --help", "solve p.g2o", "doctor", *(f"{name} --help" for name in command.COMMANDS)]
    extras = {"report .": "scenarios", "replay . key": "view", "mcap .": "mcap", "campaign drives.toml": "scenarios"}
    extras |= {f"run {name}": "(view|scenarios)" for name in SCENARIOS}
    helps = [f"run {name} --help" for name in SCENARIOS]
    example = next(block for block in fences(Path(__file__).parent.parent / "README.md") if block.language == "python")
    words = [example.code, *works, *extras, *helps]
    done = run_script(BARE, *words, cwd=tmp_path, variables={"PYTHONPATH": str(CHECKOUT)})
    example_said, *lines = done.stdout.splitlines()
    assert "The KKT conditions of the problem hold" in example_said
    for asked, status, said in map(json.loads, lines):
        extra = extras.get(asked, "scenarios")
        refused = re.search(rf"^unifg: error: .* need.* pip install 'unifg\[{extra}\]'$", said) is not None
        assert status == (2 if refused else 0), (asked, said)
        assert refused is (asked in extras) or asked in helps, (asked, said)


@dataclass(frozen=True)
class Inner:
    """Within.

    Attributes:
        weight: of what pulls: 100 % of it.
        other: no option.
    """

    weight: float = option(1.0, text=positive, metavar="W")
    other: int = 3


@dataclass(frozen=True)
class Outer:
    """Around.

    Attributes:
        file: what is read.
        kind: which way,
            told in two lines.
        quick: without looking.
        steps: how many.
        places: where; again and again.
        inner: more of it.
    """

    file: str = option()
    kind: Literal["a", "b"] | None = option(None)
    quick: bool = option(False)
    steps: int = option(2, metavar="N")
    places: tuple[tuple[float, ...], ...] = option((), text=pose, flag="place", many=True)
    inner: Inner = field(default_factory=Inner)


def options_of(*words: str, **defaults: object) -> Outer:
    parser = argparse.ArgumentParser()
    add_options(parser, Outer, **defaults)
    return settings_of(Outer, parser.parse_args(words))


def test_fields_are_options() -> None:
    assert options_of("f") == Outer("f")
    assert options_of("f", steps=5) == Outer("f", steps=5) and options_of("f", "--steps", "4", steps=5).steps == 4
    words = ["f", "--kind", "b", "--quick", "--place", "1,2,3", "--place", "4,5,6", "--weight", "0.5"]
    expected = Outer("f", "b", True, 2, ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)), Inner(0.5))
    assert options_of(*words) == expected
    for wrong in (["f", "--kind", "c"], ["f", "--steps", "-1"], ["f", "--weight", "0"], ["f", "--other", "1"], []):
        with pytest.raises(SystemExit):
            options_of(*wrong)


def test_a_range_of_radii_may_be_one_radius(
    navigation: FakeNavigation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path, "--obstacle-radius", "0.3,0.3") == 0
    assert navigation.settings[0].obstacle_radius == (0.3, 0.3)
    capsys.readouterr()
    for word, why in (("0.3,0.2", "must not be above the second"), ("0.3", "expected two numbers, without blanks")):
        assert run(tmp_path, "--obstacle-radius", word) == 2
        assert why in capsys.readouterr().err


def test_help_of_options_is_the_docstring(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        options_of("--help")
    said = " ".join(capsys.readouterr().out.split())
    for words in (
        "what is read", "--kind {a,b} which way, told in two lines", "--quick without looking",
        "--steps N how many (default: 2)", "--weight W of what pulls: 100 % of it (default: 1.0)",
    ):  # fmt: skip
        assert words in said
    assert "no option" not in said and "None" not in said
