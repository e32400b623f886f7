"""Warming up: once, again when something is missing or has changed, and told by the command."""

from __future__ import annotations

import os
import re
from functools import partial
from pathlib import Path

import numba
import pytest

from scripts import run_script
from unifg import precompile
from unifg.codegen import precompiled
from unifg.codegen.compile_counter import tally
from unifg.files.g2o import write_g2o
from unifg.pose_graphs import manhattan
from unifg.scenarios import command
from unifg.scenarios.commands import warm
from unifg.scenarios.commands.warm import missing

EXAMPLES = sorted((Path(__file__).resolve().parent.parent / "examples").glob("*.py"))


@pytest.fixture
def done(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """List of the jobs done, each of which leaves one file in a cache of its own."""
    (tmp_path / "cache").mkdir()
    monkeypatch.setattr(precompile, "cache_folder", lambda: tmp_path / "cache")
    return []


def warmed(done: list[str], kept: Path) -> list[float]:
    """Do two jobs, of which one keeps something; the shares that were told."""

    def keep() -> None:
        kept.write_text("machine code", encoding="utf-8")
        tally.files.append(str(kept))
        done.append("keep")

    told: list[float] = []
    works: list[precompile.Job] = [("keep", keep), ("more", lambda: done.append("more"))]
    precompile.perform("some", lambda: works, lambda share, title: told.append(share))
    return told


def test_what_is_there_is_left_alone(done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = tmp_path / "kept.nbi"
    assert warmed(done, kept) == [0.0, 0.5, 1.0] and done == ["keep", "more"]
    assert warmed(done, kept) == [] and len(done) == 2
    kept.unlink()  # somebody has emptied the cache
    assert warmed(done, kept) and len(done) == 4
    monkeypatch.setattr(precompile, "processor", lambda: "of another machine")
    assert warmed(done, kept) and len(done) == 6
    (mark,) = (tmp_path / "cache").iterdir()
    mark.write_text("cut o", encoding="utf-8")
    assert warmed(done, kept) and len(done) == 8


def test_a_cache_that_cannot_be_written_is_no_error(
    done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("a file where the folder should be", encoding="utf-8")
    monkeypatch.setattr(precompile, "cache_folder", lambda: tmp_path / "file")
    assert warmed(done, tmp_path / "kept.nbi") and warmed(done, tmp_path / "kept.nbi")


def test_the_command_refuses_to_compile_what_nothing_can_keep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warm, "cache_folder", lambda: None)
    assert command.main(["warmup"]) == 2
    assert "could not be kept: name a folder in UNIFG_CACHE_DIR" in capsys.readouterr().err


def leave(path: Path) -> None:
    """Leave a file with the number of the process."""
    path.write_text(str(os.getpid()), encoding="utf-8")


@pytest.mark.product(2, of="processes of their own")
def test_where_nothing_came_precompiled_processes_compile_at_once(
    done: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    works = [(name, partial(leave, tmp_path / name)) for name in ("a", "b", "c")]
    monkeypatch.setattr(precompile, "_compile_at_once", lambda done, *_: told.extend(title for title, _ in done))
    precompile.perform("some", lambda: list(works), anew=True, processes=2)
    assert told == ([] if precompiled.archive().usable else ["a", "b", "c"])
    monkeypatch.undo()
    told.clear()
    precompile._compile_at_once(list(works), 2, lambda share, title: told.append(title))
    assert sorted(told) == ["a", "b", "c"]
    assert str(os.getpid()) not in {(tmp_path / name).read_text(encoding="utf-8") for name in told}


def test_every_job_has_a_title_and_every_mode_is_rehearsed() -> None:
    titles = [title for title, _ in precompile.jobs()]
    assert len(titles) == len(set(titles)) and all(titles)
    assert {"InteriorPoint", "SQP graph", "SQP exact", "AugmentedLagrangian", "group SE3", "models"} <= set(titles)


@pytest.mark.parametrize("changed", [[], ["unifg/problem/evaluation.py"]])
def test_the_command_says_what_the_archive_is_behind(
    changed: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(precompiled, "outdated", lambda: changed)
    assert command.main(["warmup", "--check"]) == (1 if changed else 0)
    assert all(name in capsys.readouterr().out for name in changed)


WITHOUT_EXTRAS = """
import sys
from importlib.abc import MetaPathFinder

class Missing(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("pymunk", "matplotlib", "meshcat", "PIL", "tqdm", "yaml"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from unifg.codegen.compile_counter import Tally
from unifg.scenarios import command
from unifg.scenarios.commands import warm

def perform(name, works, progress, anew, processes):
    print(name, sum(title.startswith("pose graph") for title, _ in works()))
    return Tally()

warm.perform = perform
sys.exit(command.main(["warmup"]))
"""


@pytest.mark.product(2, of="processes of their own")
def test_what_could_come_precompiled_and_does_not_fails_the_making(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def leaves(progress: precompile.Progress, anew: bool) -> None:
        assert precompiled.recorder is not None and anew
        precompiled.recorder.left_out |= {"a:plain": "its result is of no plain type", "a:sliced": "raises errors"}

    monkeypatch.setattr(numba.config, "CPU_NAME", "generic")
    monkeypatch.setattr(warm, "run", leaves)
    monkeypatch.setattr(precompiled, "ARCHIVE", tmp_path / "kernels.zip")
    assert command.main(["warmup", "--ship"]) == 2 and (tmp_path / "kernels.zip").exists()
    assert "by everybody: a:sliced: write loops" in capsys.readouterr().err


def test_the_library_is_compiled_without_extras() -> None:
    done = run_script(WITHOUT_EXTRAS)
    assert done.stdout.startswith("library 2\n")
    assert "scenarios are left out, they need pymunk: pip install 'unifg[scenarios]'" in done.stdout
    assert missing() == ""


FIRST_USE = """
import runpy, sys
from unifg.codegen import jit, precompiled

found, names = jit._Cache.load_overload, set()

def look(self, signature, target):
    names.add(f"{self._py_func.__module__}:{self._py_func.__qualname__}")
    return found(self, signature, target)

jit._Cache.load_overload = look
import matplotlib
matplotlib.use("Agg")
sys.argv = sys.argv[1:]
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    mine = {name for name in names if name.startswith("unifg.") and precompiled._present(name)}
    shipped = precompiled.archive().about["functions"]
    print("looked for", len(mine), "and compiled", *sorted(mine - set(shipped) - {"unifg.lie.so2:compose"}))
"""
COMMAND = """
import sys
from unifg.scenarios.command import main
main(["solve", "map.g2o", "--effort", "full", "--scene", "--out", "."])
"""


@pytest.mark.product(1)
@pytest.mark.parametrize("script", ["unifg solve", *sorted(path.stem for path in EXAMPLES)])
def test_a_first_use_compiles_nothing_that_could_have_come(script: str, tmp_path: Path) -> None:
    """Functions of unifg that scripts call are in the archive; if one is not, unifg/precompile.py lacks a job."""
    path = tmp_path / "script.py"
    if script == "unifg solve":
        write_g2o(tmp_path / "map.g2o", manhattan(60).pose_graph)
        path.write_text(COMMAND, encoding="utf-8")
    else:
        path = EXAMPLES[0].parent / f"{script}.py"
    said = run_script(FIRST_USE, path, tmp_path, cwd=tmp_path).stdout.splitlines()[-1]
    assert re.fullmatch(r"looked for \d\d+ and compiled", said.strip()), f"{said}: add a job, then make kernels"
