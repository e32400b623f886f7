"""Draw the pictures of docs/guide/examples.md: every script of examples/, or those named (`make examples`)."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

HERE = Path(__file__).resolve().parent
CHECKOUT = HERE.parent.parent


def main() -> None:
    """Run all examples, or those named, and keep the picture that each leaves."""
    environment = {**os.environ, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    environment["PYTHONPATH"] = str(CHECKOUT)  # this checkout, whatever is installed
    for path in sorted((CHECKOUT / "examples").glob("*.py")):
        if sys.argv[1:] and path.stem not in sys.argv[1:]:
            continue
        with tempfile.TemporaryDirectory() as folder:
            print(f"{path.stem}:", flush=True)
            subprocess.run([sys.executable, str(path), folder], cwd=CHECKOUT, env=environment, check=True)
            shutil.copy(Path(folder) / f"{path.stem}.png", HERE / "examples")


if __name__ == "__main__":
    main()
