"""The rules of the house: imports point one way, the library is silent."""

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent

# Import name of each package -> its folder in the checkout.
FOLDERS = {
    "unifg": CHECKOUT / "unifg",
    "unifg.solvers": CHECKOUT / "solvers",
    "unifg.models": CHECKOUT / "models",
    "unifg.scenarios": CHECKOUT / "scenarios",
}
SIDES = ("solvers", "models", "scenarios")
# scenarios -> models, solvers -> unifg. For each package, the side packages it must not know.
FORBIDDEN = {
    "unifg": {"unifg.solvers", "unifg.models", "unifg.scenarios"},
    "unifg.solvers": {"unifg.models", "unifg.scenarios"},
    "unifg.models": {"unifg.solvers", "unifg.scenarios"},
    "unifg.scenarios": set[str](),
}


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
    path for name in ("tests", "docs", "benchmarks") for path in sources(CHECKOUT / name)
]


def name_of(path: Path) -> str:
    """Name a file as seen from the checkout."""
    return path.relative_to(CHECKOUT).as_posix()


def imports(tree: ast.AST, package: str = "") -> Iterator[tuple[int, str]]:
    """Yield (line, absolute module name) of everything imported, wherever in the file.

    Args:
        tree: Parsed module.
        package: Package the module lives in; what relative imports are relative to.
    """
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")
                base = ".".join([*parents[: len(parents) - node.level + 1], *([base] if base else [])])
            yield node.lineno, base
            # `from unifg import solvers` imports unifg.solvers
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
            if name in ("import_module", "__import__"):
                yield node.lineno, str(node.args[0].value)


def is_in(module: str, package: str) -> bool:
    """Whether a module is a package or lies inside it."""
    return module == package or module.startswith(package + ".")


def wrong_imports(source: str, package: str) -> list[str]:
    """List imports that point up the house, or at a side folder by its bare name."""
    top = next(p for p in sorted(FORBIDDEN, key=len, reverse=True) if is_in(package, p))
    return [
        f"line {line}: {module}"
        for line, module in imports(ast.parse(source), package)
        if any(is_in(module, other) for other in FORBIDDEN[top] | set(SIDES))
    ]


def package_of(top: str, path: Path) -> str:
    """Return the import name of the package a file lies in."""
    return ".".join([top, *path.relative_to(FOLDERS[top]).parts[:-1]])


@pytest.mark.parametrize(("package", "path"), LIBRARY, ids=[name_of(path) for _, path in LIBRARY])
def test_imports_point_one_way(package: str, path: Path) -> None:
    assert wrong_imports(path.read_text(encoding="utf-8"), package_of(package, path)) == []


def test_nobody_imports_side_folders_by_bare_name() -> None:
    wrong = [
        f"{name_of(path)}:{line}: {module}"
        for path in EVERYTHING
        for line, module in imports(ast.parse(path.read_text(encoding="utf-8")))
        if any(is_in(module, side) for side in SIDES)
    ]
    assert wrong == []


def test_side_folders_use_absolute_imports() -> None:
    wrong = [
        f"{name_of(path)}:{node.lineno}"
        for package, path in LIBRARY
        if package != "unifg"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.level
    ]
    assert wrong == []


@pytest.mark.parametrize(
    ("source", "package", "lines"),
    [
        ("import unifg.solvers", "unifg", 1),
        ("from unifg import models, errors", "unifg", 1),
        ("def f():\n    from unifg.scenarios.world import World", "unifg.models", 2),
        ("from .. import solvers", "unifg.lie", 1),
        ("import importlib\nimportlib.import_module('unifg.solvers.sqp')", "unifg.models", 1),
        ("import models", "unifg.scenarios", 1),
        ("from unifg.models import unicycle\nfrom unifg.solvers import SQP", "unifg.scenarios", 0),
        ("from unifg.answers.solver import Solver\nimport unifg.modelset", "unifg.models", 0),
    ],
)
def test_wrong_imports_are_found(source: str, package: str, lines: int) -> None:
    assert (len(wrong_imports(source, package)) > 0) == (lines > 0)


def test_the_library_is_silent() -> None:
    loud = [
        f"{name_of(path)}:{node.lineno}"
        for _, path in LIBRARY
        if path != CHECKOUT / "scenarios" / "cli.py"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print")
        or (isinstance(node, ast.Attribute) and ast.unparse(node) in ("sys.stdout", "sys.stderr"))
    ]
    assert loud == []


# Paths that exist on one machine only. Anchored so that addresses (example.org/home/) do not match.
MACHINE_PATH = re.compile(r"(?<![\w.\-])/(?:home|root|work|opt|Users|mnt)/\w")
TEXT = {".py", ".md", ".toml", ".cff", ".yaml", ".yml", ".in", ".cfg", ".sh", ".txt", ""}


def test_no_machine_paths() -> None:
    listing = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=CHECKOUT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    files = [CHECKOUT / name for name in listing.stdout.splitlines()]
    found = [
        f"{name_of(path)}:{number}: {line.strip()}"
        for path in files
        if path.is_file() and path.suffix in TEXT
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
        if MACHINE_PATH.search(line)
    ]
    assert found == []


def test_machine_paths_are_recognised() -> None:
    assert MACHINE_PATH.search("open('" + "/home" + "/me/map.yaml')")
    assert not MACHINE_PATH.search("https://example.org/home/me and ../shared/work/map.yaml")
