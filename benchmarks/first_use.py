"""Cost of a first use: README's first example in new environments of every Python, with an empty cache.

Pythons are found by their names on the path (``python3.11`` and later) and in the variable ``PYTHONS``, paths with
colons in between. Each gets an environment of its own, into which this checkout is installed.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.comparison import Row
from benchmarks.report import CHECKOUT, table
from benchmarks.runner import Cell, Study
from unifg.codegen.cache_folder import VARIABLE

SOURCES = "from pathlib import Path\nfrom unifg.codegen import precompiled\nprecompiled.ARCHIVE = Path('none')\n"
IMPORTS = {"numpy, numba": "import numpy, numba", "unifg": "import unifg as fg; fg.Graph, fg.solve, fg.SE2"}
DEMO = "from unifg.scenarios.command import main; main('run navigation --coupling joint --obstacles 3'.split())"
REPEATS = 3  # of imports, the least of which counts
COLUMNS = ("first", "second", "from sources", "import numpy, numba", "import unifg", "demo")


def cells(seeds: Sequence[int]) -> Iterator[Cell]:
    """The Pythons of this machine that run."""
    named = filter(None, os.environ.get("PYTHONS", "").split(":"))
    on_path = filter(None, (shutil.which(f"python3.{minor}") for minor in range(11, 20)))
    for python in dict.fromkeys([*named, *on_path]):
        if subprocess.run([python, "-c", ""], capture_output=True, check=False).returncode == 0:
            yield {"python": python}


def measure(python: str) -> Row:
    """Processor times [s] in a new environment."""
    example = (CHECKOUT / "README.md").read_text(encoding="utf-8").split("```python")[1].split("```")[0]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        subprocess.run([python, "-m", "venv", place / "env"], check=True)
        python = str(place / "env" / "bin" / "python")
        install = ["-m", "pip", "--quiet", "--disable-pip-version-check", "install", f"{CHECKOUT}[scenarios]"]
        subprocess.run([python, *install], check=True)
        found = {"first": spent(python, example, place / "cache"), "second": spent(python, example, place / "cache")}
        found["from sources"] = spent(python, SOURCES + example, place / "sources")
        for name, code in IMPORTS.items():
            found[f"import {name}"] = min(spent(python, code, place / "cache") for _ in range(REPEATS))
        found["demo"] = spent(python, DEMO, place / "demo")
        version = subprocess.run(
            [python, "-c", "import platform; print(platform.python_version())"],
            capture_output=True,
            text=True,
            check=True,
        )
    return {"version": version.stdout.strip(), **found}


def spent(python: str, code: str, cache: Path, **more: str) -> float:
    """Processor time of a process [s], without that of compiling bytecode; more variables of its environment."""
    environment = {**os.environ, VARIABLE: str(cache), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **more}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([python, "-c", code], cwd=cache.parent, env=environment, capture_output=True, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def tables(rows: list[Row]) -> str:
    """A line for each Python."""
    head = ("Python", *(f"{column} [s]" for column in COLUMNS))
    return table(head, [(row["version"], *(f"{row[column]:.2f}" for column in COLUMNS)) for row in rows], text=1)


STUDY = Study(cells, measure, tables)
