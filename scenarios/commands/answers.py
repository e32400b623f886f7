"""``unifg check``: a saved answer judged by the functions of its graph, which a script of the user's defines."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from inspect import signature
from pathlib import Path
from types import ModuleType

from unifg.errors import ScenarioError
from unifg.modeling.model import Model
from unifg.scenarios.options import find_modules_in

__all__ = ["load_graph"]


def load_graph(name: str) -> Model:
    """The graph that a script or a module defines.

    Args:
        name: ``SCRIPT.py:NAME`` or ``MODULE:NAME`` of a graph, or of a function without arguments that returns one;
            modules of the working directory are found, too.

    Raises:
        ScenarioError: there is no such script, module or graph.
    """
    where, _, attribute = name.rpartition(":")
    if not (where and attribute):
        raise ScenarioError(f"'{name}' names no graph: give SCRIPT.py:NAME or MODULE:NAME, as in plan.py:graph")
    found = getattr(_module(where), attribute, None)
    if callable(found):
        try:
            signature(found).bind()
        except (TypeError, ValueError) as error:
            raise ScenarioError(f"{where}: '{attribute}' is called without arguments, and needs some") from error
        found = found()
    if not isinstance(found, Model):
        raise ScenarioError(f"{where} defines no graph '{attribute}', nor a function that returns one")
    return found


def _module(where: str) -> ModuleType:
    """Run a script under its own name, or import a module."""
    script = Path(where)
    folder = script.parent.resolve() if script.suffix == ".py" else Path.cwd()
    find_modules_in(folder)
    if script.suffix != ".py":
        try:
            return import_module(where)
        except ImportError as error:
            raise ScenarioError(f"cannot import {where} from {folder}: {error}") from error
    spec = spec_from_file_location(script.stem, script) if script.is_file() else None
    if spec is None or spec.loader is None:
        raise ScenarioError(f"there is no script {where}")
    module = module_from_spec(spec)
    sys.modules.setdefault(script.stem, module)
    try:
        spec.loader.exec_module(module)
    except SyntaxError as error:
        raise ScenarioError(f"{where} cannot be run as Python: {error}") from error
    return module
