"""What every measurement writes beside its numbers: the machine, the state of the code, a table, a place in docs/."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import unifg
from benchmarks.pages import DIGEST_LINE, PAGES
from benchmarks.sources import digest

CHECKOUT = Path(__file__).resolve().parent.parent
OUT = CHECKOUT / "out" / "benchmarks"
BEGIN, END = "<!-- results:begin -->", "<!-- results:end -->"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], text: int = 1) -> str:
    """A Markdown table whose first ``text`` columns are words and the others numbers."""
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * text + "---:|" * (len(head) - text)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


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
