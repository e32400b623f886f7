"""casadi's functions as C: generated, compiled with the machine's own compiler, and kept by their content.

casadi evaluates expressions in a virtual machine. :func:`compiled` builds the same solver on machine code, as a robot
would run it. Compiling one of the larger control cases takes a minute, so libraries stay in out/benchmarks/.
"""

from __future__ import annotations

import contextlib
import hashlib
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.report import OUT

COMPILER = next((name for name in ("gcc", "clang", "cc") if shutil.which(name)), None)
FLAGS = ("-O2", "-march=native", "-fPIC", "-shared")
LIBRARIES = OUT / "compiled"


def compiled(solver: Any, plugin: str, options: dict[str, Any]) -> Any:
    """The solver again, its functions in machine code.

    Args:
        solver: an ``nlpsol`` of casadi.
        plugin: that it uses.
        options: with which it was made.

    Raises:
        RuntimeError: when there is no C compiler or it refuses.
    """
    import casadi as ca

    if COMPILER is None:
        raise RuntimeError("no C compiler found: install gcc, or leave compiled peers out")
    LIBRARIES.mkdir(parents=True, exist_ok=True)
    # casadi writes into the present folder
    with tempfile.TemporaryDirectory(dir=LIBRARIES) as work, contextlib.chdir(work):
        source = Path(solver.generate_dependencies("functions.c")).resolve()
        name = hashlib.sha256(source.read_bytes() + " ".join((COMPILER, *FLAGS)).encode()).hexdigest()[:16]
        library, made = LIBRARIES / f"{name}.so", Path(work) / "made.so"
        if not library.is_file():
            command = [COMPILER, *FLAGS, str(source), "-o", str(made), "-lm"]
            run = subprocess.run(command, capture_output=True, text=True, check=False)
            if run.returncode:
                raise RuntimeError(f"{COMPILER} refused: {run.stderr[:500]}")
            made.replace(library)
    return ca.nlpsol("solver", plugin, str(library), options)


def described() -> str:
    """Compiler, version and flags, in words."""
    if COMPILER is None:
        return "no C compiler"
    shown = subprocess.run([COMPILER, "-dumpfullversion", "-dumpversion"], capture_output=True, text=True, check=False)
    return f"{COMPILER} {shown.stdout.split()[0] if shown.stdout else ''} {' '.join(FLAGS[:2])}"
