"""Print constraints for pip: the lowest version that pyproject.toml allows of every package it names."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

PROJECT = Path(__file__).resolve().parent.parent / "pyproject.toml"


def lowest() -> dict[str, str]:
    """Name to version."""
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    groups = [project["dependencies"], *project["optional-dependencies"].values()]
    stated = [re.fullmatch(r"([A-Za-z0-9_.-]+)>=([0-9.]+)(,.*)?", word) for group in groups for word in group]
    return {found[1]: found[2] for found in stated if found}


if __name__ == "__main__":
    print("\n".join(f"{name}=={version}" for name, version in lowest().items()))
