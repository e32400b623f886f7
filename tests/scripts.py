"""Scripts in processes of their own, and the files of the checkout."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent


def run_script(
    script: str, *words: object, cwd: Path = CHECKOUT, variables: Mapping[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a script by Python, which has to succeed, with more variables of the environment; what it printed."""
    command = [sys.executable, "-c", script, *map(str, words)]
    place = {**os.environ, **(variables or {})}
    done = subprocess.run(command, cwd=cwd, env=place, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return done


def loaded(path: Path) -> ModuleType:
    """Run a file that no package holds, as a module of its name."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def files_in_git() -> list[Path]:
    """All files that git knows or would take, or skip the test."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    if listing.returncode != 0:
        pytest.skip("not a git checkout")
    return [CHECKOUT / name for name in listing.stdout.splitlines()]
