"""Maps of hundreds of metres: measured piece by piece and kept once; campaigns that can be run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.report import CAMPAIGNS
from unifg.models import distance_map
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.campaigns.statement import read
from unifg.scenarios.papers.bazzana import PAPER
from unifg.scenarios.papers.printed import FOLDER


def test_a_field_measured_in_pieces_is_the_field(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    walls = np.zeros((300, 420), dtype=bool)
    walls[rng.integers(0, 300, 60), rng.integers(0, 420, 60)] = True
    walls[:, :150] = False  # farther from everything than a piece and its surroundings
    walls[100:180, 200:330] = True  # a block with pieces inside that see nothing else
    for mask in (walls, ~walls):
        whole = DistanceMap.from_occupancy(mask, 0.1, (0.0, 0.0, 0.0)).values
        with monkeypatch.context() as patched:
            patched.setattr(distance_map, "PIECE", 64)
            patched.setattr(distance_map, "BESIDE", 8)
            np.testing.assert_array_equal(DistanceMap.from_occupancy(mask, 0.1, (0.0, 0.0, 0.0)).values, whole)


def test_a_field_is_kept_once() -> None:
    field = DistanceMap(np.arange(12.0).reshape(3, 4), 0.1, (0.0, 0.0, 0.0))
    assert np.shares_memory(field.values, field.table)
    around = field.table[distance_map.HEADER :].reshape(7, 8)
    np.testing.assert_array_equal(around, np.pad(np.arange(12.0).reshape(3, 4), 2, mode="edge"))


FILES = [*sorted(CAMPAIGNS.glob("*.toml")), *(FOLDER / f"{name}.toml" for name in PAPER)]


@pytest.mark.parametrize("file", FILES, ids=lambda path: Path(path).stem)
def test_campaigns_can_be_run(file: Path) -> None:
    assert len(read(file)) > 0
