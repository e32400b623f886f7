"""What every measurement shares beside its numbers: its command line, the machine, a table, a place in docs/."""

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
from typing import TypeVar

import unifg
from benchmarks.pages import CHECKOUT as CHECKOUT
from benchmarks.pages import PAGES
from unifg.scenarios.campaigns.markdown import table as table

T = TypeVar("T")
Words = TypeVar("Words", bound=tuple[str, ...])

OUT = CHECKOUT / "out" / "benchmarks"
BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"


def command(doc: str | None) -> argparse.ArgumentParser:
    """The command line of a measuring module, whose docstring says what it does and how it is called."""
    assert doc is not None
    named = re.search(r"python -m [\w.]+", doc)
    return argparse.ArgumentParser(prog=named and named[0], description=doc.split("\n")[0], allow_abbrev=False)


def shared(folder: str) -> Path | None:
    """A folder of the data sets beside the checkout or in ``$UNIFG_DATA``, if it is there."""
    path = Path(os.environ.get("UNIFG_DATA", CHECKOUT.parent / "shared" / "data")) / folder
    return path if path.is_dir() else None


def words(status: unifg.Status) -> str:
    """A status as tables name it."""
    return status.name.lower().replace("_", " ")


def listing(head: Sequence[str], groups: Mapping[Words, T], columns: Mapping[str, Callable[[T], str]]) -> str:
    """A table with a line for each group: the words that name it, then what each column tells of it."""
    lines = ([*names, *(tell(group) for tell in columns.values())] for names, group in groups.items())
    return table([*head, *columns], lines, len(head))


def machine(*packages: str) -> str:
    """One sentence: commit, date, processor, cores, Python and the versions of the packages that matter."""
    today = datetime.datetime.now(datetime.UTC).date().isoformat()
    where = f"{platform.system()} {platform.machine()} ({_processor()}, {os.cpu_count()} cores; one BLAS thread)"
    versions = ", ".join(f"{name} {_version(name)}" for name in packages)
    python = f"{platform.python_implementation()} {platform.python_version()}"
    return f"Measured at commit `{commit()}`, {today}, on {where}, {python}, {versions}."


@cache
def commit() -> str:
    """The commit of the checkout, with a plus sign where files differ from it: the state of the code measured."""
    git = partial(subprocess.run, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    name = git(["git", "rev-parse", "--short=9", "HEAD"]).stdout.strip()
    changed = git(["git", "status", "--porcelain", "--untracked-files=no", "--", "*.py"]).stdout.strip()
    return f"{name or 'unknown'}{'+' if changed else ''}"


def publish(name: str, text: str, codes: Iterable[str] | None = None, docs: bool = True) -> None:
    """Print what was measured, keep it in out/benchmarks, and put it on the page of that name.

    Args:
        name: of the text; of a page in docs/ if :data:`benchmarks.pages.PAGES` lists it.
        text: Markdown.
        codes: commits whose rows are shown, when these are not all of the present one.
        docs: False leaves docs/ alone, for runs that measured less than the page shows.
    """
    others = sorted(set(codes or ()) - {commit()})
    if others:
        text = f"{text.strip()}\n\nRows measured at commit {', '.join(f'`{code}`' for code in others)} are among these."
    print(text)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / f"{name}.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    if docs and name in PAGES:
        put_results(PAGES[name].path, PAGES[name].title, text)


def put_results(page: Path, title: str, text: str) -> None:
    """Replace what stands between the markers of a page; a missing page is begun, missing markers are appended.

    Args:
        page: to write.
        title: of a new page.
        text: Markdown.
    """
    old = page.read_text(encoding="utf-8") if page.is_file() else f"# {title}\n"
    if BEGIN not in old:
        old = f"{old.rstrip()}\n\n{BEGIN}\n{END}\n"
    before, rest = old.split(BEGIN, 1)
    _, found, after = rest.partition(END)
    if not found:
        raise ValueError(f"{page}: '{BEGIN}' has no '{END}' after it; add the line where the results end")
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(f"{before}{BEGIN}\n{text.strip()}\n{END}{after}", encoding="utf-8", newline="\n")


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return unifg.__version__ if package == "unifg" else "not installed"


def _processor() -> str:
    """The processor's marketing name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown processor"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else "unknown processor"
