"""Tables, the line that says where they were measured, and their place in a page of docs/results."""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from unifg.scenarios.campaigns.markdown import table as table
from unifg.scenarios.commands.host import processor
from unifg.scenarios.papers.measuring import words as words
from unifg.scenarios.papers.printed import shared as shared

T = TypeVar("T")
Words = TypeVar("Words", bound=tuple[str, ...])

Columns: TypeAlias = Mapping[str, Callable[[T], str]]
"""Columns of a table by heading: words of what stands in a line."""

CHECKOUT = Path(__file__).resolve().parent.parent
OUT = CHECKOUT / "out" / "benchmarks"
CAMPAIGNS = CHECKOUT / "benchmarks" / "campaigns"
PACKAGES = (
    "numpy", "scipy", "numba", "osqp", "piqp", "casadi", "gtsam", "pymunk", "mujoco", "comma-deps-acados", "drake",
    "crocoddyl", "almond-jaxls", "jax",
)  # fmt: skip


def command(doc: str | None) -> argparse.ArgumentParser:
    """Command line of a module whose docstring says what it does and how it is called."""
    assert doc is not None
    named = re.search(r"python -m [\w.]+", doc)
    return argparse.ArgumentParser(prog=named and named[0], description=doc.split("\n")[0], allow_abbrev=False)


def listing(head: Sequence[str], groups: Mapping[Words, T], columns: Columns[T]) -> str:
    """Table with a line for each group: the words that name it, then each column of it."""
    lines = ([*names, *(column(group) for column in columns.values())] for names, group in groups.items())
    return table([*head, *columns], lines, len(head))


def told(name: str, how: Callable[[Any], str] = str) -> Callable[[Mapping[str, Any]], str]:
    """Column of a measure of a row, in words; a dash where it has none."""
    return lambda row: "-" if row.get(name) is None else how(row[name])


def machine(codes: Iterable[str] = ()) -> str:
    """Sentence with commit, date, processor, cores, Python and versions of packages.

    Args:
        codes: commits whose rows are shown, when these are not all of the present one.
    """
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    where = f"{platform.system()} {platform.machine()} ({processor()}, {os.cpu_count()} cores; one BLAS thread)"
    others = "".join(f", some rows at `{code}`" for code in sorted(set(codes) - {commit()}))
    python = platform.python_version()
    return f"Measured at commit `{commit()}`{others}, {today}, on {where}, Python {python}, {versions()}."


def versions() -> str:
    """Packages that are installed, with their versions."""
    found = []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


@cache
def commit() -> str:
    """Commit of the checkout, with a plus sign where files differ from it."""
    git = partial(subprocess.run, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    name = git(["git", "rev-parse", "--short=9", "HEAD"]).stdout.strip()
    changed = git(["git", "status", "--porcelain", "--untracked-files=no", "--", "*.py"]).stdout.strip()
    return f"{name or 'unknown'}{'+' if changed else ''}"


def begin(name: str) -> str:
    """Marker before the results of a study in a page."""
    return f"<!-- results:begin {name} -->"


END = "<!-- results:end -->"


def publish(page: Path, name: str, text: str, whole: bool = True) -> None:
    """Print results, keep them in out/benchmarks, and put them in a page.

    Args:
        page: in docs/results.
        name: of the study.
        text: Markdown.
        whole: False leaves the page alone, for runs that measured less than it shows.
    """
    print(text)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / f"{name}.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    if whole:
        put_results(page, name, text)


def put_results(page: Path, name: str, text: str) -> None:
    """Replace the results between the markers of a study in a page; missing markers are appended.

    Raises:
        ValueError: a marker has no end.
    """
    old, marker = page.read_text(encoding="utf-8"), begin(name)
    if marker not in old:
        old = f"{old.rstrip()}\n\n{marker}\n{END}\n"
    before, rest = old.split(marker, 1)
    _, found, after = rest.partition(END)
    if not found:
        raise ValueError(f"{page}: '{marker}' has no '{END}' after it; add the line where the results end")
    page.write_text(f"{before}{marker}\n{text.strip()}\n{END}{after}", encoding="utf-8", newline="\n")
