"""Run the notebooks of docs/notebooks as a reader does, with a kernel, into out/notebooks: `make notebooks`.

Any cell that raises ends it with status 1. Pictures and numbers go into the copies; what is kept here has no outputs.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
OUT = HERE.parent / "out" / "notebooks"
SECONDS = 120  # for a cell, on a machine that compiles for the first time


def main() -> int:
    """Run all, or those that are named."""
    import nbformat
    from nbclient import NotebookClient
    from nbclient.exceptions import CellExecutionError

    OUT.mkdir(parents=True, exist_ok=True)
    failed = 0
    for path in sorted((HERE / "notebooks").glob("*.ipynb")):
        if sys.argv[1:] and path.stem not in sys.argv[1:]:
            continue
        began, notebook = time.perf_counter(), nbformat.read(path, as_version=4)
        try:
            NotebookClient(notebook, timeout=SECONDS, resources={"metadata": {"path": str(HERE.parent)}}).execute()
            said = "whole"
        except CellExecutionError as error:
            failed, said = 1, str(error)
        nbformat.write(notebook, OUT / path.name)
        print(f"{OUT / path.name}: {said}, {time.perf_counter() - began:.1f} s", flush=True)
    return failed


if __name__ == "__main__":
    raise SystemExit(main())
