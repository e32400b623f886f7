"""What a result depends on: the sources a module reaches by its imports, and their digest.

The digest covers the code that can change a number: the module itself, whatever of the house it imports, directly or
not, wherever in a file the import stands, and the data that lie beside those modules. Comments, docstrings and blank
lines do not count. Where a package's ``__init__`` only hands names on, ``from package import Name`` follows that name
alone: what is about KKT does not age with the interior point.
"""

from __future__ import annotations

import ast
import hashlib
import io
import tokenize
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib.util import find_spec
from pathlib import Path

__all__ = ["Sources", "code_of", "fingerprint", "library"]

DATA = (".pgm", ".png", ".yaml", ".csv", ".json")
_SIDES = ("unifg.solvers", "unifg.models", "unifg.scenarios")
# What shows numbers, or compiles ahead and so takes everything through something small, changes none.
_APART = ("unifg.scenarios.show", "unifg.view", "unifg.style", "unifg.warming")


class Sources:
    """The packages whose sources count.

    Attributes:
        folders: import name of each package -> its folder; longer names first.
        apart: modules, and packages with all in them, that do not count.
        bare: a folder whose modules are imported by their bare names; None without one.
    """

    def __init__(self, folders: Mapping[str, Path], apart: Iterable[str] = (), bare: Path | None = None) -> None:
        """Look at packages."""
        self.folders, self.apart, self.bare = dict(folders), tuple(apart), bare
        self._imported: dict[str, tuple[str, ...]] = {}
        self._handed: dict[str, dict[str, str]] = {}
        self._contents: dict[Path, bytes] = {}

    def digest(self, modules: Iterable[str]) -> str:
        """A short digest of everything ``modules`` depend on."""
        total = hashlib.sha256()
        for name, path in sorted((self.name_of(path), path) for path in self.depends_on(modules)):
            total.update(name.encode() + b"\0" + self._content(path) + b"\0")
        return total.hexdigest()[:12]

    def depends_on(self, modules: Iterable[str]) -> set[Path]:
        """Files that the modules reach by their imports, themselves included."""
        waiting, seen = list(modules), set[str]()
        files = set[Path]()
        while waiting:
            name = waiting.pop()
            path = self.located(name)
            if name in seen or path is None or any(name == a or name.startswith(a + ".") for a in self.apart):
                continue
            seen.add(name)
            files.add(path)
            files |= {beside for beside in path.parent.iterdir() if beside.suffix in DATA}
            waiting += self.imported(name)
        return files

    def name_of(self, path: Path) -> str:
        """The name of a file that is the same on every machine: below the last word of its package's name."""
        for package, folder in self.folders.items():
            if path.is_relative_to(folder):
                return f"{package.rpartition('.')[2]}/{path.relative_to(folder).as_posix()}"
        return path.name if self.bare is None else f"{self.bare.name}/{path.relative_to(self.bare).as_posix()}"

    def located(self, module: str) -> Path | None:
        """The file of a module that counts, or None."""
        for package, folder in self.folders.items():
            if module == package or module.startswith(package + "."):
                stem = folder.joinpath(*module.removeprefix(package).split(".")[1:])
                for path in (stem.with_suffix(".py"), stem / "__init__.py"):
                    if path.is_file():
                        return path
        if self.bare is None:
            return None
        bare = self.bare.joinpath(*module.split("."))
        return next((path for path in (bare.with_suffix(".py"), bare / "__init__.py") if path.is_file()), None)

    def imported(self, module: str) -> tuple[str, ...]:
        """Modules that count and that a module imports itself."""
        if module not in self._imported:
            self._imported[module] = self._read(module)
        return self._imported[module]

    def _content(self, path: Path) -> bytes:
        if path not in self._contents:
            plain = path.suffix != ".py"
            self._contents[path] = path.read_bytes() if plain else code_of(path.read_text(encoding="utf-8")).encode()
        return self._contents[path]

    def _read(self, module: str) -> tuple[str, ...]:
        path = self.located(module)
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
                known = self.located(inner) is not None
                found.append(inner if known else self._handed_on(origin).get(alias.name, origin))
        return tuple(dict.fromkeys(name for name in found if self.located(name) is not None))

    def _handed_on(self, package: str) -> dict[str, str]:
        """Where the names of a package come from, when its ``__init__`` does nothing but hand them on."""
        if package not in self._handed:
            self._handed[package] = self._names_of(package)
        return self._handed[package]

    def _names_of(self, package: str) -> dict[str, str]:
        path = self.located(package)
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
                or (isinstance(node, ast.FunctionDef) and node.name == "__dir__")
            ):
                return {}
        return origins


def library(extra: str | None = None) -> Sources:
    """The library as it is installed here, without what only shows numbers, and a package of somebody else's."""
    folders = {name: _folder(name) for name in (*_SIDES, "unifg")}
    top = None if extra is None else extra.partition(".")[0]
    spec = None if top in (None, "unifg") else find_spec(str(top))
    if spec is not None and spec.origin is not None:
        here = Path(spec.origin).resolve()
        folders[str(top)] = here.parent if spec.submodule_search_locations else here.with_suffix("")
    elif spec is not None and spec.submodule_search_locations:
        folders[str(top)] = Path(next(iter(spec.submodule_search_locations))).resolve()
    return Sources(folders, _APART)


@cache
def fingerprint() -> str:
    """A digest of all sources of the library byte by byte, by which machines know that they run the same."""
    total = hashlib.sha256()
    for name in ("unifg", *_SIDES):
        folder = _folder(name)
        for path in sorted(folder.rglob("*.py")):
            if name == "unifg" and f"unifg.{path.relative_to(folder).parts[0]}" in _SIDES:
                continue  # installed, or reached by a link, they lie inside
            total.update(f"{name}/{path.relative_to(folder).as_posix()}".encode() + b"\0" + path.read_bytes() + b"\0")
    return total.hexdigest()[:12]


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


def _folder(package: str) -> Path:
    spec = find_spec(package)
    assert spec is not None and spec.submodule_search_locations
    return Path(next(iter(spec.submodule_search_locations))).resolve()


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
