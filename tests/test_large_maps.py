"""Maps of hundreds of metres: measured piece by piece, planned coarse to fine, and those of the campaigns as drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import large_maps
from unifg.files.ros_map import OccupancyMap, load_map
from unifg.models import distance_map
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.campaigns.statement import read
from unifg.scenarios.ways import coarse, grid
from unifg.typing import BoolArray, IntArray

CAMPAIGNS = large_maps.CAMPAIGNS


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


def test_a_coarse_search_leads_to_the_same_way(monkeypatch: pytest.MonkeyPatch) -> None:
    occupancy, _ = large_maps.department()
    field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    start, goal = (11.52, 3.18, 0.0), (11.52, 12.69, 0.0)
    fine = grid.plan(occupancy, field, start, goal, robot_radius=0.17)
    searched = list[int]()
    real = grid._cheapest

    def counted(cells: BoolArray, *more: Any) -> IntArray:
        searched.append(int(np.count_nonzero(cells)))
        return real(cells, *more)

    monkeypatch.setattr(grid, "_cheapest", counted)
    monkeypatch.setattr(grid, "_LARGE", 0)
    np.testing.assert_array_equal(grid.plan(occupancy, field, start, goal, robot_radius=0.17), fine)
    blocks, cells = searched
    assert blocks < 20_000 and cells < 100_000 < np.count_nonzero(occupancy.free)


def test_a_wall_thinner_than_a_block_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two rooms that join far away: blocks on both sides of the wall touch, cells do not."""
    monkeypatch.setattr(grid, "_LARGE", 0)
    occupied = np.zeros((80, 1200), dtype=bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[39, :1100] = True
    occupancy = OccupancyMap(occupied, ~occupied, 0.05, (0.0, 0.0, 0.0), "thin")
    field = DistanceMap.from_occupancy(occupied, 0.05, (0.0, 0.0, 0.0))
    path = grid.plan(occupancy, field, (2.0, 0.9, 0.0), (2.0, 3.0, 0.0), robot_radius=0.02, clearance_preferred=0.02)
    assert path[:, 0].max() > 54.9
    joined = coarse.pooled(~occupied)
    assert joined[4, 3] and joined[5, 3], "the blocks themselves do not see the wall"


def test_the_maps_of_campaigns_are_those_that_are_drawn() -> None:
    for draw in (large_maps.department, large_maps.factory):
        drawn, rooms = draw()
        shipped = load_map(CAMPAIGNS / f"{drawn.name}.yaml")
        np.testing.assert_array_equal(shipped.occupied, drawn.occupied)
        np.testing.assert_array_equal(shipped.free, drawn.free)
        assert (shipped.resolution, shipped.origin, shipped.name) == (drawn.resolution, drawn.origin, drawn.name)
        assert len(rooms) > 40


@pytest.mark.parametrize("file", sorted(CAMPAIGNS.glob("*.toml")), ids=lambda path: Path(path).stem)
def test_campaigns_can_be_run(file: Path) -> None:
    assert len(read(file)) > 0
