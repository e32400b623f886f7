"""The machine that a run was made on, in one line."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

import numpy as np

__all__ = ["machine"]


def machine() -> str:
    """Properties that two comparable ratios share."""
    name = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # systems that tell otherwise, or nothing
    python = (
        f"{platform.python_implementation()} {platform.python_version_tuple()[0]}.{platform.python_version_tuple()[1]}"
    )
    return f"{platform.system()}, {name}, {python}, numpy {np.__version__}, numba {metadata.version('numba')}"
