"""An episode of a campaign again, from what its line says."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

from unifg.errors import ScenarioError
from unifg.scenarios.campaigns.campaign import episodes_of, manifest_of
from unifg.scenarios.campaigns.stated_settings import nearest
from unifg.scenarios.campaigns.statement import built, module_of

__all__ = ["episode_of"]


def episode_of(folder: Path, key: str) -> tuple[ModuleType, Any]:
    """Module that runs an episode, and its settings.

    Args:
        folder: of the campaign.
        key: of the episode; its beginning does where there is no other like it.

    Raises:
        ScenarioError: there is no such episode, or its settings no longer fit.
    """
    base = Path(manifest_of(folder)["base"])
    rows = {row["key"]: row for row in episodes_of(folder) if row["key"].startswith(key)}
    if not rows:
        known = [row["key"] for row in episodes_of(folder)]
        raise ScenarioError(f"{folder}: no episode {key!r} is on file; {nearest(key, known[:1000])}")
    if len(rows) > 1:
        raise ScenarioError(f"{folder}: {key!r} may mean {' or '.join(sorted(rows)[:5])}")
    (row,) = rows.values()
    return module_of(row["scenario"]), built(row["scenario"], row["settings"], row["seed"], base, key)
