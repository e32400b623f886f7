"""Cost of a first use: README's worked problem in fresh processes whose cache is empty.

``python -m benchmarks.first_use`` prints a row for each backend, and one for all of them one after another in one
process: processor time with the half compiled kernels that come with the library, from the sources alone, and from a
cache that has everything.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.report import table
from unifg.codegen.cache_folder import VARIABLE

CHECKOUT = Path(__file__).resolve().parent.parent
BACKENDS = {
    "InteriorPoint": "InteriorPoint()",
    "AugmentedLagrangian": "AugmentedLagrangian()",
    "SQP": "SQP()",
    'SQP(qp="graph")': 'SQP(qp="graph")',
    'SQP(hessian="exact")': 'SQP(hessian="exact")',
}
CHILD = """
import json, sys, time
from pathlib import Path
from unifg.codegen import precompiled
from unifg.codegen.compile_counter import tally
if sys.argv[2] == "sources":
    precompiled.ARCHIVE = Path("none")
from unifg.solvers import InteriorPoint
text = Path("README.md").read_text(encoding="utf-8").split("```python")[2].split("for solver in")[0]
exec(text)
begin = time.process_time()
for make in json.loads(sys.argv[1]):
    eval(make).solve(graph, guess, check=True)
print(json.dumps([time.process_time() - begin, len(tally.compiled), len(tally.generated)]))
"""


def measured(makes: list[str], way: str, cache: str) -> tuple[float, int, int]:
    """Processor time [s] of the solves of a fresh process, and how many functions it compiled and generated."""
    environment = {**os.environ, VARIABLE: cache, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", CHILD, json.dumps(makes), way],
        cwd=CHECKOUT, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    seconds, compiled, generated = json.loads(done.stdout.splitlines()[-1])
    return float(seconds), int(compiled), int(generated)


def rows(names: list[str]) -> list[list[str]]:
    """One for each backend, and one for all."""
    found = []
    for name in [*names, "all of them"]:
        makes = [BACKENDS[key] for key in names] if name == "all of them" else [BACKENDS[name]]
        cells = [name]
        for way in ("shipped", "sources"):
            with tempfile.TemporaryDirectory() as cache:
                seconds, compiled, generated = measured(makes, way, cache)
                cells.append(f"{seconds:.1f} s, {generated if way == 'shipped' else compiled} functions")
                if way == "shipped" and compiled:
                    cells[-1] += f", {compiled} compiled"
                again = measured(makes, way, cache)[0]
        found.append([*cells, f"{again:.2f} s"])
    return found


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=BACKENDS, help="one backend instead of all")
    chosen = parser.parse_args().only
    head = ["backend", "first use, with what is shipped", "first use, from the sources", "from the cache"]
    print(table(head, rows([chosen] if chosen else list(BACKENDS))))


if __name__ == "__main__":
    main()
