"""Every script of examples/ runs, is short enough to be read at once, and does what its first line says."""

import importlib.util
import runpy
from pathlib import Path
from types import ModuleType

import pytest

import unifg as fg

CHECKOUT = Path(__file__).resolve().parent.parent
EXAMPLES = sorted((CHECKOUT / "examples").glob("*.py"))
LINES = 60


def example(name: str) -> ModuleType:
    """An example as a module, without what it prints."""
    spec = importlib.util.spec_from_file_location(name, CHECKOUT / "examples" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_and_is_short(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "Agg")
    runpy.run_path(str(path), run_name="__main__")
    assert len(path.read_text(encoding="utf-8").splitlines()) < LINES


@pytest.mark.parametrize("coupling", ["separate", "sequential", "joint"])
def test_the_car_parks_whatever_the_coupling(coupling: str) -> None:
    away, error, statuses = example("joint_past_future").main(coupling, seed=1)
    assert away < 0.5 and error < 0.2  # a position is measured to 0.2 m in each coordinate
    assert statuses[fg.Status.CONVERGED] == sum(statuses.values()) == 60


@pytest.mark.parametrize("coupling", ["sequential", "joint"])
def test_the_arm_learns_its_friction(coupling: str) -> None:
    away, error, friction, statuses = example("own_robot_loop").main(coupling, seed=1)
    assert away < 0.15 and error < 0.03
    assert friction == pytest.approx([0.8, 0.4], abs=0.05)
    assert statuses[fg.Status.CONVERGED] > 55 and sum(statuses.values()) == 60
