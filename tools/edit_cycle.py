"""Cost of a change: README's first example after a comment, and after a formula, in central compiled functions.

``python -m tools.edit_cycle`` copies the checkout, runs the example until everything is in a cache of its own, and then
changes one function at a time. Processor times [s] of the next run; of a run that changes nothing first.
"""

from __future__ import annotations

import ast
import shutil
import sys
import tempfile
from pathlib import Path

from benchmarks.first_use import spent
from benchmarks.report import CHECKOUT

CENTRAL = (
    ("unifg/lie/so2.py", "wrap"),
    ("unifg/lie/so3.py", "exp"),
    ("unifg/lie/se3.py", "log"),
    ("unifg/factors/robust.py", "weight_of"),
    ("unifg/factors/whitening.py", "whiten"),
    ("unifg/problem/evaluation.py", "linearize"),
    ("unifg/problem/hessian.py", "add_curvature"),
    ("unifg/elimination/fronts.py", "factor"),
    ("unifg/elimination/substitution.py", "solve"),
    ("solvers/interior_point/barrier.py", "measure"),
)


def changed(path: Path, function: str, line: str) -> str:
    """Source with a line more at the beginning of a function's body.

    Raises:
        KeyError: the file has no such function.
    """
    source = path.read_text(encoding="utf-8")
    found = {node.name: node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef)}
    body = found[function].body
    first = body[1] if ast.get_docstring(found[function]) is not None and len(body) > 1 else body[0]
    lines = source.split("\n")
    lines.insert(first.lineno - 1, " " * first.col_offset + line)
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    example = (CHECKOUT / "README.md").read_text(encoding="utf-8").split("```python")[1].split("```")[0]
    with tempfile.TemporaryDirectory() as folder:
        checkout, cache = Path(folder, "checkout"), Path(folder, "cache")
        left_out = shutil.ignore_patterns(".*", "out", "build", "dist", "*.egg-info", "__pycache__")
        shutil.copytree(CHECKOUT, checkout, symlinks=True, ignore=left_out)
        for _ in range(2):
            still = spent(sys.executable, example, cache, PYTHONPATH=str(checkout))
        print(f"{'nothing':<54} {still:6.2f}")
        for name, function in CENTRAL:
            path = checkout / name
            kept = path.read_text(encoding="utf-8")
            times = []
            for line in ("# a comment", "changed = 1.0"):
                path.write_text(changed(path, function, line), encoding="utf-8")
                times.append(spent(sys.executable, example, cache, PYTHONPATH=str(checkout)))
                path.write_text(kept, encoding="utf-8")
            spent(sys.executable, example, cache, PYTHONPATH=str(checkout))
            print(f"{name + ' ' + function:<54} comment {times[0]:6.2f}  formula {times[1]:6.2f}", flush=True)


if __name__ == "__main__":
    main()
