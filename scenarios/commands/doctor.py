"""Examination of an installation: ``unifg doctor``.

Versions, what is missing and for what; the caches of compiled functions, where they are, whether they can be written
and are whole; threads; every backend on a problem with a known answer, and its time beside the recorded one.
"""

from __future__ import annotations

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import numpy as np

import unifg as fg
from unifg.codegen import precompiled
from unifg.codegen.cache_folder import VARIABLE, cache_folder
from unifg.codegen.objects import read_sealed
from unifg.codegen.threads import cores
from unifg.errors import UnifgError
from unifg.scenarios.commands import performance
from unifg.scenarios.commands.extras import PACKAGES
from unifg.scenarios.commands.outcome import Progress
from unifg.scenarios.workers import THREADS

__all__ = ["Finding", "examined"]

NEEDED = ("numpy", "scipy", "numba", "llvmlite", "osqp", "piqp", "qpsolvers")
CORRECT = 1e-5  # of a cost, relative to max(1, cost)
SECONDS = 2.0  # given to reading the cache
REPEATS = 7
SLOW = 2.0  # times the recorded ratio, from which a backend is called slow


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        part: heading it stands under.
        text: what was found.
        good: False where something is wrong; None where something could be better, or is of another kind.
    """

    part: str
    text: str
    good: bool | None = True


def examined(progress: Progress) -> Iterator[Finding]:
    """Look at everything, part by part."""
    parts: tuple[tuple[str, Callable[[], Iterator[Finding]]], ...] = (
        ("versions", _versions), ("caches", _caches), ("threads", _threads), ("backends", _backends),
    )  # fmt: skip
    for k, (name, look) in enumerate(parts):
        progress(k / len(parts), name)
        yield from look()
    progress(1.0, "done")


def _versions() -> Iterator[Finding]:
    where = Path(fg.__file__).resolve().parent
    yield Finding("versions", f"unifg {fg.__version__} in {where}")
    yield Finding(
        "versions", f"{platform.python_implementation()} {platform.python_version()} on {platform.platform()}"
    )
    missing = [name for name in NEEDED if _version(name) is None]
    yield Finding("versions", ", ".join(f"{name} {_version(name)}" for name in NEEDED if name not in missing))
    if missing:
        yield Finding("versions", f"missing: {', '.join(missing)}; install unifg again", good=False)
    there = [one.name for module, one in PACKAGES.items() if find_spec(module) is not None]
    if there:
        yield Finding("versions", ", ".join(f"{name} {_version(name)}" for name in there))
    for name, extra, purpose in PACKAGES.values():
        if name not in there:
            yield Finding("versions", f"{name} is not installed; it is for {purpose}: unifg[{extra}]", good=None)


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _caches() -> Iterator[Finding]:
    folder = cache_folder()
    if folder is None:
        yield Finding(
            "caches",
            f"no folder for compiled functions can be written: every process compiles anew; name one in {VARIABLE}",
            good=False,
        )
    else:
        yield from _cache(folder)
    if precompiled.archive().usable:
        changed = precompiled.outdated()
        behind = f"; functions that have changed since and are compiled instead: {len(changed)}" if changed else ""
        yield Finding("caches", f"kernels that come half compiled fit this LLVM and Numba{behind}", not changed or None)
    else:
        yield Finding(
            "caches", "the kernels that come half compiled are of another LLVM, Numba or platform: a first use "
            "compiles, which takes minutes once (`unifg warmup`)", good=None,
        )  # fmt: skip


def _cache(folder: Path) -> Iterator[Finding]:
    """Files of compiled functions in a folder."""
    files = sorted(folder.glob("*.code"))
    size = sum(file.stat().st_size for file in files if file.is_file())  # a link, or another process, may lead nowhere
    yield Finding("caches", f"{len(files)} compiled functions, {size / 1e6:.0f} MB in {folder}")
    began, read, damaged = time.monotonic(), 0, list[Path]()
    for file in files:
        if time.monotonic() - began > SECONDS:
            break
        read += 1
        if read_sealed(file) is None:
            damaged.append(file)
    if damaged:
        yield Finding("caches", f"{len(damaged)} of {read} damaged, to be compiled anew: {damaged[0]}", good=None)
    elif read:
        yield Finding("caches", f"{'all' if read == len(files) else read} of them read and whole")
    else:
        yield Finding("caches", "nothing is compiled yet: `unifg warmup` does it beforehand", good=None)


def _threads() -> Iterator[Finding]:
    stated = ", ".join(f"{name}={os.environ[name]}" for name in THREADS if name in os.environ)
    yield Finding(
        "threads",
        f"{cores()} of {os.cpu_count()} cores for this process; {stated or 'no limit on threads of linear algebra'}",
    )
    if "OMP_NUM_THREADS" not in os.environ:
        yield Finding(
            "threads", "matrices here are small: OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 spares what waits for others",
            good=None,
        )  # fmt: skip
    if not getattr(sys, "_is_gil_enabled", lambda: True)():
        yield Finding("threads", "this Python has no global lock, which nothing here has been tested with", good=None)


def _backends() -> Iterator[Finding]:
    """Every backend from nothing, and repeated beside the reference."""
    try:
        record = performance.last(performance.history())
    except UnifgError:
        record = None
    for name, solve, right in performance.self_tests():
        try:
            began = time.perf_counter()
            solution = solve()
            first = time.perf_counter() - began
        except Exception as error:  # whatever it is, the others are asked as well
            yield Finding("backends", f"{name:8} {type(error).__name__}: {error}", good=False)
            continue
        off = abs(solution.cost - right) / max(1.0, right)
        if not solution.converged or off > CORRECT:
            said = f"{solution.status.name}, cost {solution.cost:.9g} for {right:.9g}"
            yield Finding("backends", f"{name:8} wrong: {said}", good=False)
            continue
        ratio, took, _ = np.median([performance.beside_reference(solve) for _ in range(REPEATS)], axis=0).tolist()
        text = f"{name:8} right; first {first:6.2f} s, then {1e3 * took:6.2f} ms"
        recorded = None if record is None else record.ratios.get(f"backend {name}")
        factor = ratio / float(np.median(recorded)) if recorded else 1.0
        text += f", {factor:.1f} times the recorded" if recorded else ""
        yield Finding("backends", text, None if factor > SLOW else True)


def report(findings: list[Finding]) -> str:
    """The report."""
    lines, part = list[str](), ""
    for finding in findings:
        if finding.part != part:
            part = finding.part
            lines.append(f"{part}:")
        lines.append(f"  {'  ' if finding.good else '! ' if finding.good is None else 'X '}{finding.text}")
    wrong = sum(finding.good is False for finding in findings)
    lines += ["", "all is well" if not wrong else f"{wrong} {'thing is' if wrong == 1 else 'things are'} wrong (X)"]
    return "\n".join(lines)
