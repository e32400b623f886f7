"""Pages that are made: README, changelog, scripts, and a reference of every public name from the docstrings.

There is a page for each public module, with an entry for each name that it lists or, where it lists none, defines.
Nothing is imported: sources are read, so the site is built where nothing but its own tools is installed.
"""

from __future__ import annotations

import ast
import json
from collections.abc import Iterator
from functools import cache
from inspect import cleandoc
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parent.parent.parent
NOTEBOOKS = sorted((CHECKOUT / "docs" / "notebooks").glob("*.ipynb"))
ROOMS = (
    "unifg", "unifg.solvers", "unifg.horizon", "unifg.smoothing", "unifg.pose_graphs", "unifg.view", "unifg.lie",
    "unifg.layers", "unifg.torch", "unifg.jax",
)  # fmt: skip
"""Their names are public where they are listed."""
SHELVES = ("unifg.models", "unifg.files")
"""The modules that they list are."""
ALONE = ("unifg.solution.solver", "unifg.solvers.names")
MOVED = {
    "](../../README.md": "](../readme.md",
    "](../../CHANGELOG.md": "](../changelog.md",
    "](../../CONTRIBUTING.md": "](../contributing.md",
    "](../../LICENSE": "](../license.md",
    "](../../examples/": "](../examples/",
    "](../README.md": "](readme.md",
    "](../CHANGELOG.md": "](changelog.md",
    "](../CONTRIBUTING.md": "](contributing.md",
    "](../LICENSE": "](license.md",
    "](../examples/": "](examples/",
}
"""Links out of the folder of pages, and where they lead on the site."""


def pages() -> dict[str, str]:
    """Text of every page that is made, by its address."""
    made = {name.lower(): _from_above(CHECKOUT / name) for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")}
    made["license.md"] = f"# License\n\n{(CHECKOUT / 'LICENSE').read_text()}"
    made["CITATION.cff"] = (CHECKOUT / "CITATION.cff").read_text()
    made |= {f"examples/{path.name}": path.read_text() for path in sorted((CHECKOUT / "examples").glob("[!_]*.py"))}
    made |= {f"notebooks/{path.stem}.md": _told(path) for path in NOTEBOOKS}
    for module, names in public().items():
        entries = "\n".join(entry(module, name) for name in names)
        made[f"api/{module}.md"] = f"# {module}\n\n{summary(module)}\n\n{entries}"
    listed = "\n".join(f"- [{module}]({module}.md): {summary(module)}" for module in public())
    made["api/index.md"] = f"# Reference\n\nEvery public name, by the module it is imported from.\n\n{listed}\n"
    return made


def _told(notebook: Path) -> str:
    """A notebook as a page: its words, its code, and where to get it."""
    cells = json.loads(notebook.read_text())["cells"]
    parts = ["".join(cell["source"]) for cell in cells]
    for k, cell in enumerate(cells):
        if cell["cell_type"] == "code":
            parts[k] = f"```python\n{parts[k]}\n```"
    title, *rest = parts[0].split("\n", 1)
    return "\n\n".join([title, f"[As a notebook]({notebook.name}) to run and change.", *rest, *parts[1:]]) + "\n"


@cache
def public() -> dict[str, list[str]]:
    """Public names by module, each by the first one that lists it."""
    shelved = [f"{shelf}.{module}" for shelf in SHELVES for module in names_of(shelf)]
    found: dict[str, list[str]] = {}
    known = set[tuple[str, str]]()
    for module in (*ROOMS, *shelved, *ALONE):
        own = {name: origin(module, name) for name in names_of(module)}
        if new := [name for name, place in own.items() if place not in known]:
            found[module] = new
        known |= set(own.values())
    return found


def origin(module: str, name: str) -> tuple[str, str]:
    """Module that defines what another one lists, and its name there."""
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("unifg"):
            for alias in node.names:
                if (alias.asname or alias.name) == name:
                    return origin(str(node.module), alias.name)
    return module, name


def folder(module: str) -> Path:
    """Path of a package's folder, or of a module without its suffix."""
    return CHECKOUT.joinpath(*module.split("."))


@cache
def tree_of(module: str) -> ast.Module:
    """Syntax tree of a module."""
    path = folder(module)
    return ast.parse((path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text())


def names_of(module: str) -> list[str]:
    """Names that a module lists, or the public names that it defines."""
    tree = tree_of(module)
    for node in tree.body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__":
            listed: list[str] = ast.literal_eval(node.value)
            return listed
    return [name for name in _defined(tree) if not name.startswith("_")]


def summary(module: str) -> str:
    """First paragraph of a module's docstring."""
    text = ast.get_docstring(tree_of(module))
    if not text:
        raise ValueError(f"{module} has no docstring")
    return text.split("\n\n")[0].replace("\n", " ")


def entry(module: str, name: str) -> str:
    """Entry of a name in the reference: its docstring, or the text that a residual was given for ``help``."""
    text = told(module, name)
    return f"::: {module}.{name}\n" if text is None else f"## {name}\n\n{_markdown(text)}\n"


def told(module: str, name: str) -> str | None:
    """The text that a residual was given; None for what is no residual."""
    module, name = origin(module, name)
    values = {}
    for node in tree_of(module).body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            values[node.targets[0].id] = node.value
    value = values.get(name)
    if not isinstance(value, ast.Call) or ast.unparse(value.func) not in ("residual", "ManifoldResidual"):
        return None
    given = [*value.args, *(keyword.value for keyword in value.keywords)]
    followed = [values.get(part.id, part) if isinstance(part, ast.Name) else part for part in given]
    texts = [part.value for part in followed if isinstance(part, ast.Constant) and isinstance(part.value, str)]
    return cleandoc(max(texts, key=len)) if texts else None


def _from_above(path: Path) -> str:
    """A page that lies beside this folder, its links led to the pages of the site."""
    text = path.read_text().replace("](docs/", "](").replace('src="docs/', 'src="').replace('srcset="docs/', 'srcset="')
    return text.replace("](CHANGELOG.md", "](changelog.md").replace("](LICENSE", "](license.md")


def _defined(tree: ast.Module) -> Iterator[str]:
    """Classes, functions but for compiled loops, and residuals."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.FunctionDef):
            if not any("compiled" in ast.unparse(decorator) for decorator in node.decorator_list):
                yield node.name
        elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Call):
            if ast.unparse(node.value.func) in ("residual", "ManifoldResidual"):
                yield ast.unparse(node.targets[0])


def _markdown(text: str) -> str:
    """Sections of a docstring as bold lines, code of its examples as code."""
    lines: list[str] = []
    for line in text.replace("``", "`").split("\n"):
        if line in ("Args:", "Returns:", "Raises:"):
            lines.append(f"\n**{line[:-1]}**\n")
        else:
            lines.append(line.replace("    ", "- ", 1) if _item(line) else line)
    return "\n".join(lines)


def _item(line: str) -> bool:
    """Test whether a line begins the description of an argument."""
    return line.startswith("    ") and not line.startswith("     ") and ":" in line
