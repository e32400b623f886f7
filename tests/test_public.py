"""Public names: the names of unifg, and whatever the documentation imports."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import pydoc
from types import ModuleType
from typing import Literal, get_origin

import pytest

import unifg as fg
from fences import PYTHON, documents, fences
from scripts import run_script
from unifg.modeling.factors import ManifoldResidual

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
    "unifg.codegen.compile_counter",
    "unifg.errors",
    "unifg.layers",
    "unifg.solution.solver",
    "unifg.solution.status",
    "unifg.problem.hessian",
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


# What `import unifg` need not load: it comes with the first backend, picture or smoother that asks for it.
LATE = (
    "scipy", "osqp", "piqp", "qpsolvers", "platformdirs", "matplotlib", "pandas", "casadi", "email", "numba.np.linalg",
    "unifg.solvers", "unifg.models", "unifg.smoothing", "unifg.plots", "unifg.style", "unifg.view", "unifg.horizon",
    "unifg.files", "unifg.pose_graphs", "unifg.scenarios", "unifg.precompile", "unifg.layers", "torch", "jax",
)  # fmt: skip


def test_the_import_loads_what_a_graph_is_made_of_alone() -> None:
    """And compiles nothing."""
    script = f"""
import sys
import numpy, numba
from numba.core import event
listener = event.RecordingListener()
there = {{*sys.modules}}
with event.install_listener("numba:compile", listener):
    import unifg as fg
assert not listener.buffer, listener.buffer
fg.Graph, fg.solve, fg.SE2
late = [name for name in {LATE} if name in {{*sys.modules}} - there]
assert not late, late
assert fg.FixedLag.__module__ == "unifg.smoothing.fixed_lag" and "unifg.smoothing" in sys.modules
with event.install_listener("numba:compile", listener):
    numba.njit(lambda x: x + 1)(1.0)
assert listener.buffer  # the witness sees what there is to see
"""
    run_script(script)


@pytest.mark.parametrize("room", [room for room in OPEN if room != "unifg.scenarios"])
def test_rooms_list_what_is_public_and_nothing_else(room: str) -> None:
    module = importlib.import_module(room)
    assert sorted(dir(module)) == sorted(module.__all__)
    for name in module.__all__:
        found = getattr(module, name)
        assert inspect.getdoc(found) or get_origin(found) is Literal, name
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        _ = module.nothing_of_the_kind


def test_a_module_of_models_is_listed_where_it_lists_names() -> None:
    room = importlib.import_module("unifg.models")
    modules = {
        found.name: importlib.import_module(f"unifg.models.{found.name}")
        for found in pkgutil.iter_modules(room.__path__)
    }
    assert room.__all__ == sorted(name for name, module in modules.items() if hasattr(module, "__all__"))


def test_help_speaks_of_the_residual_and_not_of_its_class() -> None:
    boilerplate = {inspect.getdoc(fg.Residual), inspect.getdoc(ManifoldResidual)}
    shipped = [importlib.import_module(f"unifg.models.{name}") for name in dir(importlib.import_module("unifg.models"))]
    told = 0
    for module in [fg, importlib.import_module("unifg.pose_graphs"), *shipped]:
        for name, value in vars(module).items():
            if isinstance(value, (fg.Residual, ManifoldResidual)) and not name.startswith("_"):
                assert inspect.getdoc(value) not in boilerplate, (module.__name__, name)
                told += 1
    assert told > 20
    between = pydoc.plain(pydoc.render_doc(fg.between))
    assert all(word in between for word in ("Log(measured^-1 x^-1 y)", "Args:", "(n, storage)", "m, m, rad", "Raises:"))

    def mine(x: object, y: object) -> object:
        """Distance of the ball from the bat [m]."""
        return x

    assert "from the bat" in pydoc.render_doc(fg.residual(mine))  # type: ignore[arg-type]
    assert "better" in pydoc.render_doc(fg.residual(mine, about="Said better."))  # type: ignore[arg-type]


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
