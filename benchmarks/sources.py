"""What a measurement depends on: the sources it reaches by its imports, and their digest.

The digest covers the code that can change a number: the module that measures, whatever of this checkout it imports,
directly or not, wherever in a file the import stands, and the data that lie beside those modules. Comments, docstrings
and blank lines do not count. Where a package's ``__init__`` only hands names on, ``from package import Name`` follows
that name alone: a page about KKT does not age with the interior point.

What presents numbers (:data:`PRESENTATION`) or compiles ahead (:data:`AHEAD`) does not count either, nor do peers:
their versions stand on the pages.
"""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent
# Import name -> folder; longer names first.
FOLDERS = {
    "unifg.solvers": CHECKOUT / "solvers",
    "unifg.models": CHECKOUT / "models",
    "unifg.scenarios": CHECKOUT / "scenarios",
    "unifg": CHECKOUT / "unifg",
    "benchmarks": CHECKOUT / "benchmarks",
}
BARE = CHECKOUT / "tests"
"""Its modules are imported by their bare names: problems that tests and measurements share."""
PRESENTATION = {"benchmarks", "benchmarks.pages", "benchmarks.report", "benchmarks.sources"}
AHEAD = {"unifg.warming"}
"""Takes everything through something small: what is compiled before a measurement is no part of it."""
DATA = (".pgm", ".yaml", ".csv", ".json")


def digest(modules: Iterable[str]) -> str:
    """A short digest of everything ``modules`` depend on."""
    total = hashlib.sha256()
    for path in sorted(depends_on(modules), key=lambda p: p.relative_to(CHECKOUT).as_posix()):
        total.update(path.relative_to(CHECKOUT).as_posix().encode() + b"\0" + _content(path) + b"\0")
    return total.hexdigest()[:12]


def depends_on(modules: Iterable[str]) -> set[Path]:
    """Files of the checkout that the modules reach by their imports, themselves included."""
    waiting, seen = list(modules), set[str]()
    files = set[Path]()
    while waiting:
        name = waiting.pop()
        path = located(name)
        if name in seen or path is None or name in PRESENTATION | AHEAD:
            continue
        seen.add(name)
        files.add(path)
        files |= {beside for beside in path.parent.iterdir() if beside.suffix in DATA}
        waiting += imported(name)
    return files


def located(module: str) -> Path | None:
    """The file of a module of this checkout, or None."""
    for package, folder in FOLDERS.items():
        if module == package or module.startswith(package + "."):
            stem = folder.joinpath(*module.removeprefix(package).split(".")[1:])
            for path in (stem.with_suffix(".py"), stem / "__init__.py"):
                if path.is_file():
                    return path
    bare = BARE.joinpath(*module.split("."))
    return next((path for path in (bare.with_suffix(".py"), bare / "__init__.py") if path.is_file()), None)


@cache
def imported(module: str) -> tuple[str, ...]:
    """Modules of this checkout that a module imports itself."""
    path = located(module)
    assert path is not None
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    found = list[str]()
    for node in _imports(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
            continue
        parents = package.split(".")
        base = ".".join([*parents[: len(parents) - node.level + 1], *([node.module] if node.module else [])])
        origin = base if node.level else (node.module or "")
        for alias in node.names:
            inner = f"{origin}.{alias.name}"
            found.append(inner if located(inner) is not None else _handed_on(origin).get(alias.name, origin))
    return tuple(dict.fromkeys(name for name in found if located(name) is not None))


def code_of(source: str) -> str:
    """A source without comments, docstrings, blank lines and blanks at the ends of lines."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.Expr) or not isinstance(node.value, ast.Constant):
            continue
        if isinstance(node.value.value, str):  # strings that stand alone are docstrings, of attributes too
            for row in range(node.lineno - 1, node.end_lineno or node.lineno):
                lines[row] = ""
    return "\n".join(line.rstrip() for line in lines if line.strip())


@cache
def _content(path: Path) -> bytes:
    return code_of(path.read_text(encoding="utf-8")).encode() if path.suffix == ".py" else path.read_bytes()


def _imports(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """Import statements, but for those that only type checkers see."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING"):
            for other in node.orelse:
                yield from _imports(other)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.stmt | ast.excepthandler | ast.match_case):  # expressions hold no imports
            yield from _imports(node)


@cache
def _handed_on(package: str) -> dict[str, str]:
    """Where the names of a package come from, when its ``__init__`` does nothing but hand them on."""
    path = located(package)
    if path is None or path.name != "__init__.py":
        return {}
    body = ast.parse(path.read_text(encoding="utf-8")).body
    origins = dict[str, str]()
    for node in body:
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            origins |= {alias.asname or alias.name: node.module for alias in node.names}
        elif not (
            (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
            or (isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__")
        ):
            return {}
    return origins
