"""What every measurement shares beside its numbers: its command line, the machine, a table, a place in docs/."""

from __future__ import annotations

import argparse
import os
import platform
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import unifg
from benchmarks.pages import DIGEST_LINE, PAGES
from benchmarks.sources import CHECKOUT as CHECKOUT
from benchmarks.sources import digest
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
    """One sentence: processor, cores, Python and the versions of the packages that matter."""
    versions = ", ".join(f"{name} {_version(name)}" for name in packages)
    return (
        f"Measured on {platform.system()} {platform.machine()} ({_processor()}, {os.cpu_count()} cores; one BLAS "
        f"thread), {platform.python_implementation()} {platform.python_version()}, {versions}."
    )


def code_digest(module: str) -> str:
    """A short digest of what a measuring module depends on: results of two states of the code are never mixed."""
    return digest([module])


def publish(name: str, text: str, codes: Iterable[str] | None = None, docs: bool = True) -> None:
    """Print what was measured, keep it in out/benchmarks, and put it on the page of that name.

    Args:
        name: of the text; of a page in docs/ if :data:`benchmarks.pages.PAGES` lists it.
        text: Markdown.
        codes: digests of the states of the code that were measured, when that was not now.
        docs: False leaves docs/ alone, for runs that measured less than the page shows.
    """
    print(text)
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / f"{name}.md").write_text(text + "\n", encoding="utf-8", newline="\n")
    if docs and name in PAGES:
        put_results(PAGES[name].path, PAGES[name].title, text, codes)


def put_results(page: Path, title: str, text: str, codes: Iterable[str] | None = None) -> None:
    """Replace what stands between the markers of a page; a missing page is begun, missing markers are appended.

    The digest of the sources goes with it, by which :mod:`benchmarks.pages` knows whether the page is up to date.

    Args:
        page: to write.
        title: of a new page.
        text: Markdown.
        codes: digests of the states of the code that were measured, when that was not now; mixed ones make a page that
            counts as stale.
    """
    known = PAGES.get(page.stem)
    if known is not None and known.path == page:
        measured = set(codes if codes is not None else [known.digest])
        text = f"{text.strip()}\n\n{DIGEST_LINE.format(' and '.join(f'`{code}`' for code in sorted(measured)))}"
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
