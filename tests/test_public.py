"""What is public: the names of unifg, and whatever the documentation imports."""

from __future__ import annotations

import ast
import importlib
import inspect
from types import ModuleType

import pytest

import unifg as fg
from fences import PYTHON, documents, fences

# Rooms whose modules a user imports by name; all others are organs, but for what a backend of one's own is made of.
OPEN = (
    "unifg.lie",
    "unifg.solvers",
    "unifg.models",
    "unifg.scenarios",
    "unifg.pose_graphs",
    "unifg.files",
    "unifg.view",
    "unifg.horizon",
)
OPEN_MODULES = {
    "unifg",
    "unifg.machine.tally",
    "unifg.errors",
    "unifg.answers.solver",
    "unifg.answers.status",
    "unifg.program.curvature",
}


def test_dir_lists_what_is_public() -> None:
    assert dir(fg) == sorted([*fg.__all__, "__version__"])
    assert len(set(fg.__all__)) == len(fg.__all__)
    for name in fg.__all__:
        found = getattr(fg, name)
        assert not isinstance(found, ModuleType) and not name.startswith("_")
        assert inspect.getdoc(found), name
    leaked = [
        name
        for name, value in vars(fg).items()
        if not name.startswith("_") and name not in fg.__all__ and not isinstance(value, ModuleType)
    ]
    assert leaked == []


def imported(source: str) -> list[tuple[str, str]]:
    """Modules of unifg and the names taken from them."""
    return [
        (node.module, alias.name)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == "unifg"
        for alias in node.names
    ]


@pytest.mark.parametrize("page", documents(), ids=lambda page: page.name)
def test_the_documentation_imports_what_is_public(page: object) -> None:
    for fence in fences(page):  # type: ignore[arg-type]
        if fence.language not in PYTHON or fence.skip is not None:
            continue
        for module, name in imported(fence.code):
            where = f"{fence.place}: from {module} import {name}"
            assert module in OPEN_MODULES or module.startswith(OPEN), where
            found = getattr(importlib.import_module(module), name, None)
            assert found is not None or importlib.import_module(f"{module}.{name}"), where
            assert not name.startswith("_"), where
