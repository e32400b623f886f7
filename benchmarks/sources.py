"""The sources behind a measurement: those of this checkout, the measuring modules and the problems they share.

What presents numbers or compiles ahead does not count, nor do peers: their versions stand on the pages. Nor does what
``fg.solve`` picks from, which ``import unifg`` brings along: who measures names the backends.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from unifg.scenarios.campaigns.sources import Sources

CHECKOUT = Path(__file__).resolve().parent.parent
SOURCES = Sources(
    {
        "unifg.solvers": CHECKOUT / "solvers",
        "unifg.models": CHECKOUT / "models",
        "unifg.scenarios": CHECKOUT / "scenarios",
        "unifg": CHECKOUT / "unifg",
        "benchmarks": CHECKOUT / "benchmarks",
    },
    apart=(
        "benchmarks.pages", "benchmarks.report", "benchmarks.sources", "unifg.warming", "unifg.solvers.choice",
        "unifg.scenarios.campaigns.journal", "unifg.scenarios.workers",
        "unifg.scenarios.campaigns.dispatch", "unifg.scenarios.campaigns.sources",
    ),
    bare=CHECKOUT / "tests",
)  # fmt: skip


def digest(modules: Iterable[str]) -> str:
    """A short digest of everything ``modules`` depend on."""
    return SOURCES.digest(modules)
