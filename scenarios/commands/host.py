"""The machine that a run was made on, in one line."""

from __future__ import annotations

import platform
from importlib import metadata
from pathlib import Path

import numpy as np

__all__ = ["machine", "processor"]


def processor() -> str:
    """Marketing name of the processor where the system gives it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):  # systems that tell otherwise, or nothing
        return platform.processor() or platform.machine()


def machine() -> str:
    """Properties that two comparable ratios share."""
    python = f"{platform.python_implementation()} {'.'.join(platform.python_version_tuple()[:2])}"
    return f"{platform.system()}, {processor()}, {python}, numpy {np.__version__}, numba {metadata.version('numba')}"
