"""The rules of the house: imports point down, floor by floor and without a circle; the library is silent."""

import ast
import importlib
import inspect
import re
from functools import cache
from pathlib import Path

import pytest

from scripts import CHECKOUT, files_in_git

# Import name of each package -> its folder in the checkout.
FOLDERS = {
    "unifg": CHECKOUT / "unifg",
    "unifg.solvers": CHECKOUT / "solvers",
    "unifg.models": CHECKOUT / "models",
    "unifg.scenarios": CHECKOUT / "scenarios",
}
SIDES = ("solvers", "models", "scenarios")
# From the ground up. A room knows the floors below it; rooms of one floor do not know each other.
FLOORS: tuple[tuple[str, ...], ...] = (
    ("errors", "typing", "locks", "atomic_write"),
    ("codegen", "style"),
    ("lie", "elimination"),
    ("factors",),
    ("modeling",),
    ("problem", "plots"),
    ("solution",),
    ("solvers", "smoothing", "models"),
    ("horizon", "pose_graphs"),
    ("files", "layers"),
    ("torch", "jax"),
    ("view",),
    ("precompile",),
    ("unifg",),  # the names of the user's script, gathered
    ("scenarios",),
    ("benchmarks",),
    ("tools",),
)
FLOOR = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
# Inside scenarios/, where "" are the files that lie in no room: one per scenario.
STOREYS: tuple[tuple[str, ...], ...] = (
    ("options", "stopwatch", "planning", "workers"),
    ("perception",),
    ("monitoring", "simulation"),
    ("ground", "quadrotor"),
    ("logs",),
    ("",),
    ("scenes",),
    ("commands",),
    ("campaigns",),
    ("papers",),
    ("command",),
)
STOREY = {room: floor for floor, rooms in enumerate(STOREYS) for room in rooms}


def sources(folder: Path) -> list[Path]:
    """List the Python files below a folder without following the links to the side folders."""
    return sorted(
        path
        for path in folder.rglob("*.py")
        if not any(p.is_symlink() for p in path.parents if p.is_relative_to(folder) and p != folder)
        and "__pycache__" not in path.parts
    )


LIBRARY = [(package, path) for package, folder in FOLDERS.items() for path in sources(folder)]
EVERYTHING = [path for _, path in LIBRARY] + [
    path for name in ("tests", "docs", "benchmarks", "tools", "examples") for path in sources(CHECKOUT / name)
]
MEASURING = {name: CHECKOUT / name for name in ("benchmarks", "tools")}
HOUSE = [*LIBRARY, *((name, path) for name, folder in MEASURING.items() for path in sources(folder))]


@cache
def tree_of(source: str) -> ast.Module:
    """Parse a source once."""
    return ast.parse(source)


@cache
def nodes_of(source: str) -> tuple[ast.AST, ...]:
    """All nodes of a source."""
    return tuple(ast.walk(tree_of(source)))


@cache
def text_of(path: Path) -> str:
    """Read a file once."""
    return path.read_text(encoding="utf-8")


def nodes_in(path: Path) -> tuple[ast.AST, ...]:
    """All nodes of a file."""
    return nodes_of(text_of(path))


def name_of(path: Path) -> str:
    """Name a file as seen from the checkout."""
    return path.relative_to(CHECKOUT).as_posix()


@cache
def imports(source: str, package: str = "") -> tuple[tuple[int, str], ...]:
    """All (line, absolute module name) of everything imported, wherever in the file.

    Args:
        source: Text of a module.
        package: Package the module lives in; what relative imports are relative to.
    """
    found = list[tuple[int, str]]()
    for node in nodes_of(source):
        if isinstance(node, ast.Import):
            found += ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                base = ".".join([*parents[: len(parents) - node.level + 1], *([base] if base else [])])
            found.append((node.lineno, base))
            # `from unifg import solvers` imports unifg.solvers
            found += ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name in ("import_module", "__import__"):
                found.append((node.lineno, str(node.args[0].value)))
    return tuple(found)


def is_in(module: str, package: str) -> bool:
    """Test whether a module is a package or lies inside it."""
    return module == package or module.startswith(package + ".")


def module_of(top: str, path: Path) -> str:
    """Return the import name of a file, of a package for its ``__init__``."""
    parts = [top, *path.relative_to((FOLDERS | MEASURING)[top]).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


MODULES = {module_of(top, path): path for top, path in HOUSE}


def package_of(module: str) -> str:
    """Return what relative imports of a module are relative to."""
    return module if MODULES[module].name == "__init__.py" else module.rpartition(".")[0]


def room_of(module: str) -> str:
    """Return the room a module lies in, "unifg" for the package itself."""
    top, _, rest = module.partition(".")
    return rest.partition(".")[0] or top if top == "unifg" else top


def storey_of(module: str) -> int:
    """Return the storey of a module of scenarios/."""
    first, _, rest = module.removeprefix("unifg.scenarios").lstrip(".").partition(".")
    return STOREY[first if rest or first in STOREY else ""]


@cache
def known(source: str, package: str) -> tuple[tuple[int, str], ...]:
    """(line, module) of what a source imports of this house; of a name in a module, the module."""
    found = []
    for line, name in imports(source, package):
        module = name if name in MODULES else name.rpartition(".")[0]
        if module in MODULES and (module == name or module != "unifg"):
            found.append((line, module))
    return tuple(found)


def wrong_imports(source: str, module: str, package: str) -> list[str]:
    """List imports that point up the house or to another room of the same floor."""
    room = room_of(module)
    return [
        f"line {line}: {other}"
        for line, other in known(source, package)
        if room_of(other) != room and FLOOR[room_of(other)] >= FLOOR[room]
    ]


def test_every_room_stands_on_a_floor() -> None:
    assert {room_of(module) for module in MODULES} == set(FLOOR)


def test_imports_point_down() -> None:
    wrong = {
        module: found
        for module, path in MODULES.items()
        if (found := wrong_imports(text_of(path), module, package_of(module)))
    }
    assert wrong == {}


def test_imports_of_scenarios_point_down() -> None:
    up = [
        f"{module}, line {line}: {other}"
        for module, path in MODULES.items()
        if room_of(module) == "scenarios"
        for line, other in known(text_of(path), package_of(module))
        if room_of(other) == "scenarios" and storey_of(other) > storey_of(module)
    ]
    assert up == []


def test_no_file_knows_itself_by_way_of_others() -> None:
    knows = {
        module: {other for _, other in known(text_of(path), package_of(module))}
        for module, path in MODULES.items()
        if path.name != "__init__.py"
    }
    while True:  # who knows nobody of those left, and whom nobody left knows, is in no circle
        inner = {other for module, others in knows.items() for other in others - {module}}
        free = [m for m, others in knows.items() if m not in inner or not others & (knows.keys() - {m})]
        if not free:
            break
        for module in free:
            del knows[module]
    assert sorted(knows) == []


def test_nobody_imports_side_folders_by_bare_name() -> None:
    wrong = [
        f"{name_of(path)}:{line}: {module}"
        for path in EVERYTHING
        for line, module in imports(text_of(path))
        if any(is_in(module, side) for side in SIDES)
    ]
    assert wrong == []


# Tests of the measurements themselves; all others take their problems from tests/problems.
OF_MEASUREMENTS = {
    "test_baselines.py", "test_benchmarks.py", "test_compiled_peers.py", "test_experiments.py", "test_golden.py",
    "test_large_maps.py", "test_mutants.py", "test_peers.py", "test_performance.py", "test_planner.py",
    "test_printed.py", "test_quadrotor_flights.py", "test_quadrotor_joint.py", "test_quadrotor_obstacles.py",
    "test_robust.py",
    "test_unification_studies.py", "test_walks.py",
}  # fmt: skip


def test_tests_and_their_problems_know_no_measurements() -> None:
    knowing = {
        path.name
        for path in sources(CHECKOUT / "tests")
        for _, module in imports(text_of(path))
        if is_in(module, "benchmarks") or is_in(module, "tools")
    }
    assert knowing == OF_MEASUREMENTS


def test_side_folders_use_absolute_imports() -> None:
    wrong = [
        f"{name_of(path)}:{node.lineno}"
        for package, path in LIBRARY
        if package != "unifg"
        for node in nodes_in(path)
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ("source", "module", "wrong"),
    [
        ("import unifg.solvers", "unifg.solution.check", True),
        ("from unifg import models, errors", "unifg.solvers.sqp", True),
        ("def f():\n    from unifg.scenarios.simulation.plane import World", "unifg.models.lidar", True),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from unifg.solution.solution import Solution",
         "unifg.problem.table", True),
        ("from .. import solvers", "unifg.lie.so2", True),
        ("import importlib\nimportlib.import_module('unifg.solvers.sqp')", "unifg.models.lidar", True),
        ("import unifg as fg", "unifg.models.lidar", True),
        ("import unifg as fg", "unifg.scenarios.ground.drive_past", False),
        ("from unifg.models import unicycle\nfrom unifg.solvers import SQP", "unifg.scenarios.ground.route", False),
        ("from unifg.solution.solver import Solver\nimport unifg.modelset", "unifg.models.lidar", False),
    ],
)  # fmt: skip
def test_wrong_imports_are_found(source: str, module: str, wrong: bool) -> None:
    assert bool(wrong_imports(source, module, package_of(module))) == wrong


# Statements (without imports and docstrings) by part and room. They go down with every change that takes something
# away; what raises one takes as much away elsewhere, or says in CHANGELOG why not.
BUDGETS = {
    "unifg solvers models": 34_605, "scenarios": 13_103, "benchmarks": 4_740, "tests": 38_728,
    "docs examples": 1_989, "unifg/factors": 4_309, "unifg/problem": 3_596, "models": 2_347,
    "unifg/elimination": 2_192, "solvers": 5_342, "unifg/solution": 3_422, "unifg/smoothing": 1_952,
    "unifg/lie": 1_399, "unifg/view": 1_526, "unifg/files": 1_370, "unifg/pose_graphs": 2_035,
    "unifg/horizon": 1_597, "unifg/modeling": 1_206, "unifg/codegen": 1_357, "unifg/plots": 415,
    "scenarios/scenes": 1_318, "scenarios/simulation": 1_374, "scenarios/campaigns": 938,
    "scenarios/quadrotor": 1_748, "scenarios/ground": 1_874, "scenarios/commands": 680,
    "scenarios/logs": 654, "scenarios/perception": 948, "scenarios/planning": 876,
}  # fmt: skip
# Nodes of syntax a statement: budgets are not met by denser code.
DENSITY = {"unifg solvers models": 34_605.0, "scenarios": 13_103.6, "benchmarks": 11.9, "tests": 38_728.3}


@cache
def size_of(path: Path) -> tuple[int, int]:
    """Statements of a file, without imports and docstrings, and nodes of syntax."""
    statements = nodes = 0
    for node in nodes_in(path):
        text = isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)
        statements += isinstance(node, ast.stmt) and not text and not isinstance(node, ast.Import | ast.ImportFrom)
        nodes += isinstance(node, ast.stmt | ast.expr)
    return statements, nodes


def sized(folders: str) -> tuple[int, float]:
    """Statements below folders, without imports and docstrings, and nodes of syntax a statement."""
    found = [size_of(path) for folder in folders.split() for path in sources(CHECKOUT / folder)]
    statements, nodes = map(sum, zip(*found, strict=True))
    return statements, nodes / statements


def test_size_keeps_its_budget() -> None:
    measured = {folders: sized(folders) for folders in BUDGETS}
    over = {f: found for f, (found, _) in measured.items() if found > BUDGETS[f]}
    slack = {f: found for f, (found, _) in measured.items() if found < 0.98 * BUDGETS[f] - 10}
    assert over == {}, "take as much away elsewhere"
    assert slack == {}, "lower the budget to what there is"
    assert {f: density for f, (_, density) in measured.items() if density > DENSITY.get(f, 16.0)} == {}


def test_files_and_functions_are_short() -> None:
    assert {name_of(path): lines for path in EVERYTHING if (lines := text_of(path).count("\n")) > 700} == {}
    files = [path for path in EVERYTHING if not path.is_relative_to(CHECKOUT / "tests")]
    functions = [node for path in files for node in nodes_in(path) if isinstance(node, ast.FunctionDef)]
    assert {one.name for one in functions if (one.end_lineno or one.lineno) - one.lineno >= 150} == set()


def test_docstrings_begin_with_a_noun_or_a_verb() -> None:
    words = ("What", "Whether", "Who", "Where", "How", "Which", "When", "By")
    asking = [
        f"{name_of(path)}:{getattr(node, 'lineno', 1)}: {text.partition(chr(10))[0]}"
        for path in EVERYTHING
        for node in nodes_in(path)
        if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.Module)
        and (text := ast.get_docstring(node) or "").partition(" ")[0].rstrip(",.:") in words
    ]
    assert asking == []


def test_the_library_is_silent() -> None:
    loud = [
        f"{name_of(path)}:{node.lineno}"
        for _, path in LIBRARY
        if path != CHECKOUT / "scenarios" / "command.py"
        for node in nodes_in(path)
        if (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print")
        or (isinstance(node, ast.Attribute) and ast.unparse(node) in ("sys.stdout", "sys.stderr"))
    ]
    assert loud == []


# Paths that exist on one machine only. Anchored so that addresses (example.org/home/) do not match.
MACHINE_PATH = re.compile(r"(?<![\w.\-])/(?:home|root|work|opt|Users|mnt)/\w")
TEXT = {".py", ".md", ".toml", ".cff", ".yaml", ".yml", ".in", ".cfg", ".sh", ".txt", ""}


def test_products_of_long_vectors_wake_no_threads() -> None:
    """Solvers multiply vectors as long as the problem by `unifg.codegen.inner`, not by a BLAS that shares them out."""
    woken = re.compile(r"float\((?:[^()]|\([^()]*\))* @ |np\.linalg\.norm\((?![^\n]*axis)|np\.vdot\(")
    assert woken.search("slope = float(gradient @ step)") and woken.search("size = float(np.linalg.norm(residual))")
    assert woken.search("float(step @ curved(step))") and not woken.search("np.linalg.norm(rows, axis=1)")
    folders = ("solvers", "unifg/solution")
    found = [
        f"{path.relative_to(CHECKOUT)}:{number}: {line.strip()}"
        for folder in folders
        for path in sorted((CHECKOUT / folder).rglob("*.py"))
        if path.parent.name != "ta"  # its matrices are those of one state
        for number, line in enumerate(text_of(path).splitlines(), 1)
        if woken.search(line)
    ]
    assert not found, "\n".join(found)


def test_no_machine_paths() -> None:
    files = files_in_git()
    found = [
        f"{name_of(path)}:{number}: {line.strip()}"
        for path in files
        if path.is_file() and path.suffix in TEXT
        for number, line in enumerate(text_of(path).splitlines(), start=1)
        if MACHINE_PATH.search(line)
    ]
    assert found == []


def test_machine_paths_are_recognised() -> None:
    assert MACHINE_PATH.search("open('" + "/home" + "/me/map.yaml')")
    assert not MACHINE_PATH.search("https://example.org/home/me and ../shared/work/map.yaml")


# What Numba and llvmlite do not promise: modules below the surface, and the inside of what njit returns.
PRIVATE_MODULE = re.compile(r"^(numba\.(core|extending|np|cpython|misc|experimental|typed|types)|llvmlite)(\.|$)")
PRIVATE_NAME = re.compile(r"\.(py_func|overloads|targetoptions|get_pointer_to_function|_cache|nopython_signatures)\b")


def private_sides(source: str) -> list[str]:
    """List where a source reaches into Numba."""
    modules = [f"line {line}: {name}" for line, name in imports(source) if PRIVATE_MODULE.match(name)]
    lines = enumerate(source.splitlines(), start=1)
    return modules + [f"line {number}: {line.strip()}" for number, line in lines if PRIVATE_NAME.search(line)]


def test_only_the_machine_knows_the_inside_of_numba() -> None:
    wrong = {
        name_of(path): found
        for package, path in HOUSE
        if room_of(module_of(package, path)) != "codegen" and (found := private_sides(text_of(path)))
    }
    assert wrong == {}
    inside = [path for package, path in LIBRARY if room_of(module_of(package, path)) == "codegen"]
    assert any(private_sides(text_of(path)) for path in inside)  # the witness sees what there is


# Names of Numba that it does not promise, and where they are found: all that unifg.codegen uses.
BELOW_THE_SURFACE = {
    "_unique_ids": "numba.core.bytecode:FunctionIdentity",
    "_final_module": "numba.core.codegen:CPUCodeLibrary",
    "_get_module_for_linking": "numba.core.codegen:CPUCodeLibrary",
    "_optimize_final_module": "numba.core.codegen:CPUCodeLibrary",
    "_finalize_final_module": "numba.core.codegen:CPUCodeLibrary",
    "_set_compiled_object": "numba.core.codegen:CodeLibrary",
    "_engine": "numba.core.codegen:CPUCodegen",
    "_defined_symbols": "numba.core.codegen:JitEngine",
    "_add_module": "numba.core.codegen:JITCPUCodegen",
    "_tm": "numba.core.codegen:JITCPUCodegen",
    "_cache": "numba.core.dispatcher:Dispatcher",
    "_compile_for_args": "numba.core.dispatcher:_DispatcherBase",
    "_getvalue": "numba.core.cgutils:_StructProxy",
    "_helperlib": "numba",
    "_nrt_python": "numba.core.runtime",
}


@pytest.mark.parametrize("name", BELOW_THE_SURFACE)
def test_a_private_name_of_numba_is_there(name: str) -> None:
    """It fails by the name that a new version of Numba has taken away."""
    module, _, kind = BELOW_THE_SURFACE[name].partition(":")
    found = importlib.import_module(module)
    assert hasattr(found, name) or name in inspect.getsource(getattr(found, kind)), name


def test_no_other_private_name_of_numba_is_used() -> None:
    own = set[str]()
    used = set[str]()
    for package, path in LIBRARY:
        if room_of(module_of(package, path)) != "codegen":
            continue
        for node in nodes_in(path):
            if isinstance(node, ast.Attribute) and node.attr.startswith("_") and not node.attr.startswith("__"):
                mine = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls", "own")
                (own if mine else used).add(node.attr)
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                own.add(node.name)
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("numba"):
                used |= {alias.name for alias in node.names if alias.name.startswith("_")}
    assert used - own - {"_fields"} <= set(BELOW_THE_SURFACE)
    assert "getrefcount" not in "".join(text_of(path) for _, path in LIBRARY)


def test_numba_has_no_expiry_date() -> None:
    """The tests above name what a newer one has taken away; `test_compiled_cache` shows what becomes of it then."""
    text = (CHECKOUT / "pyproject.toml").read_text(encoding="utf-8")
    assert re.search(r'"numba>=\d+\.\d+",', text), "pyproject.toml gives numba a lowest version alone"
