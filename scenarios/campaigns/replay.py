"""An episode of a campaign again, from what its line says."""

from __future__ import annotations

import logging
from pathlib import Path
from types import ModuleType
from typing import Any

from unifg.errors import ScenarioError
from unifg.scenarios.campaigns.campaign import code_of, episodes_of, manifest_of
from unifg.scenarios.campaigns.stated_settings import nearest
from unifg.scenarios.campaigns.statement import built, module_of, stated

__all__ = ["episode_of"]

logger = logging.getLogger("unifg")


def episode_of(folder: Path, key: str) -> tuple[ModuleType, Any]:
    """Module that runs an episode, and its settings; a warning says that the code has changed since.

    Args:
        folder: of the campaign.
        key: of the episode; its beginning does where there is no other like it.

    Raises:
        ScenarioError: there is no such episode, or its settings no longer fit.
    """
    manifest = manifest_of(folder)
    base = Path(manifest["base"])
    rows = {row["key"]: row for row in episodes_of(folder) if row["key"].startswith(key)}
    if not rows:
        known = [row["key"] for row in episodes_of(folder)]
        raise ScenarioError(f"{folder}: no episode {key!r} is on file; {nearest(key, known[:1000])}")
    if len(rows) > 1:
        raise ScenarioError(f"{folder}: {key!r} may mean {' or '.join(sorted(rows)[:5])}")
    (row,) = rows.values()
    then, now = row.get("code"), code_of(stated(manifest["campaign"], base))
    if then != now:
        logger.warning("%s was run by other code (%s, now %s): its numbers may differ", row["key"], then, now)
    return module_of(row["scenario"]), built(row["scenario"], row["settings"], row["seed"], base, key)
