"""Seed of what is drawn by commit: cases of large tables, and pages whose shell commands are run."""

import os
import subprocess
from functools import cache

from scripts import CHECKOUT


@cache
def seed() -> str:
    """Return $UNIFG_TEST_SEED, else the commit."""
    if named := os.environ.get("UNIFG_TEST_SEED"):
        return named
    found = subprocess.run(
        ["git", "rev-parse", "--short=8", "HEAD"], cwd=CHECKOUT, capture_output=True, text=True, check=False
    )
    return found.stdout.strip() or "0"
