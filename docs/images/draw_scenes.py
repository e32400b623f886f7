"""Make the scenes of docs/guide/examples.md: `python docs/images/draw_scenes.py` with unifg[view]."""

from __future__ import annotations

import json
import runpy
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

DOCS = Path(__file__).resolve().parent.parent
SCENES = DOCS / "scenes"


def main() -> None:
    """The tower of an example, and the flight of a notebook."""
    SCENES.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        sys.argv = ["scene_of_my_graph.py", folder]
        runpy.run_path(str(DOCS.parent / "examples" / "scene_of_my_graph.py"))
        shutil.copyfile(Path(folder) / "solution.html", SCENES / "tower.html")
    scope: dict[str, Any] = {}
    for cell in json.loads((DOCS / "notebooks" / "quadrotor.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), scope)
    print(scope["scene"].save(SCENES / "eight.html"))


if __name__ == "__main__":
    main()
