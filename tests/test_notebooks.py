"""Notebooks run from top to bottom; they are kept without outputs, which differ from machine to machine."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from scripts import CHECKOUT
from unifg.view import Scene

NOTEBOOKS = sorted((CHECKOUT / "docs" / "notebooks").glob("*.ipynb"))
ASKED_FOR = {"cart_pole", "parking", "range_only_slam", "quadrotor", "swapping_backends"}


def cells(path: Path) -> list[dict[str, Any]]:
    """Those of a notebook."""
    found: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return found


def test_all_are_there_and_bare() -> None:
    assert {path.stem for path in NOTEBOOKS} == ASKED_FOR
    for path in NOTEBOOKS:
        assert cells(path)[0]["cell_type"] == "markdown" and cells(path)[0]["source"][0].startswith("# ")
        code = [cell for cell in cells(path) if cell["cell_type"] == "code"]
        assert all(cell["outputs"] == [] and cell["execution_count"] is None for cell in code), f"clear {path.name}"


@pytest.mark.product(3)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("Agg")
    monkeypatch.chdir(tmp_path)
    scope = ModuleType("__main__").__dict__
    for number, cell in enumerate(cells(path)):
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{path.name}, cell {number}", "exec"), scope)
    plt.close("all")
    assert list(tmp_path.iterdir()) == [], "a notebook leaves no files where its reader did not ask for any"


def test_a_scene_is_shown_inside_a_notebook() -> None:
    scene = Scene('A "scene" & more')
    scene.points("a", np.zeros((2, 3)))
    shown = scene._repr_html_()
    assert shown.startswith('<iframe srcdoc="') and shown.count('"') == 4, (
        "nothing of the page ends the attribute early"
    )
    assert "&lt;script&gt;" in shown
