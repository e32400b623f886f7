"""Robots that are lost: places that are found, told apart and given up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maps
from test_supervision import BEAMS, DT
from unifg.files.ros_map import save_map
from unifg.models.planar import ackermann, base_of
from unifg.scenarios.ground.calibration import BIAS
from unifg.scenarios.ground.creeping import Creeping
from unifg.scenarios.ground.drive_pilot import DOUBTFUL, Pilot, make_pilot
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.drive_signals import RAMPS
from unifg.scenarios.ground.hypotheses import Hypothesis
from unifg.scenarios.ground.localiser import FITS, Localiser
from unifg.scenarios.ground.relocalise import BELIEVED, PORTION, Found, Relocaliser
from unifg.scenarios.monitoring.supervisor import Health, HealthReport
from unifg.scenarios.navigation import Episode, NavigationSettings, askew
from unifg.scenarios.perception.explaining import explained
from unifg.scenarios.perception.readings import Scan
from unifg.scenarios.simulation.plane import World


def searched(search: Relocaliser, sample: Scan) -> tuple[Found, int]:
    """Result of a search, and the number of its portions."""
    search.begin(sample)
    for ticks in range(1, 1000):
        found = search.search()
        if found is not None:
            return found, ticks
    raise AssertionError


@pytest.mark.product(2, of="drives and flights")
@pytest.mark.parametrize("place", [(3.0, 25.2, 2.0), (21.0, 9.6, -2.0)], ids=str)
def test_a_robot_put_down_anywhere_is_found(place: tuple[float, float, float]) -> None:
    occupancy, field = maps.building()
    search = Relocaliser(occupancy, field, 0.17)
    found, ticks = searched(search, World(occupancy, place).scan())
    assert found.pose is not None and found.share > 0.9 and found.cause == ""
    assert np.hypot(*(found.pose - place)[:2]) < 0.05
    assert abs(math.remainder(found.pose[2] - place[2], 2.0 * np.pi)) < 0.02
    assert ticks == math.ceil(len(search.places) / PORTION) and not search.searching


@pytest.mark.product(2, of="drives and flights")
def test_a_scan_of_another_building_is_found_nowhere() -> None:
    occupancy, field = maps.building()
    other = askew(occupancy, np.array([10.8, 17.0, 0.0]))
    where = World(other, (10.8, 17.0, 0.0))
    found, _ = searched(Relocaliser(occupancy, field, 0.17), where.scan())
    assert found.pose is None and found.cause


def cells(begin: float, end: float) -> slice:
    """Cells of a map from a place to another [m]."""
    return slice(round(begin / maps.CELL), round(end / maps.CELL))


SHELVES = [(cells(y, y + 0.6), cells(4.0, 22.0)) for y in (2.0, 4.4)]
HALL = maps.walled(
    26.0, 8.0, blocks=[*SHELVES, (cells(5.0, 6.0), cells(0.0, 1.0)), (cells(1.0, 3.0), cells(24.5, 26.0))]
)


def test_places_in_an_aisle_look_alike_and_those_at_its_end_do_not() -> None:
    search = Relocaliser(HALL, maps.field(HALL), 0.34)
    inside, _ = searched(search, World(HALL, (13.0, 3.5, 0.3)).scan())
    assert inside.pose is None and inside.cause == "several places on the map look alike"
    assert len(inside.rivals) > 1 and inside.share > BELIEVED
    outside, _ = searched(search, World(HALL, (23.2, 3.9, -0.4)).scan())
    assert outside.pose is not None and len(outside.rivals) == 1
    np.testing.assert_allclose(outside.pose, [23.2, 3.9, -0.4], atol=0.05)


def among_people(sample: Scan) -> Scan:
    """Somebody stands to both sides."""
    return replace(sample, ranges=np.where(np.arange(BEAMS) % 180 < 80, np.minimum(sample.ranges, 0.9), sample.ranges))


def test_no_place_is_found_in_walls_or_off_the_map() -> None:
    """Beams that end 0.9 m away fit walls from behind, too."""
    sample = among_people(World(HALL, (22.6, 3.5, -2.5)).scan())
    found, _ = searched(Relocaliser(HALL, maps.field(HALL), 0.17), sample)
    assert found.pose is None and found.cause == "no place on the map fits the scan" and found.share < 0.8


class Finding:
    """A search whose result is known."""

    def __init__(self, *results: Found | None) -> None:
        self.results, self.searching = list(results), True

    def begin(self, scan: Scan | None) -> None:
        """There is nothing to begin."""

    def search(self, portion: int) -> Found | None:
        """One result after the other."""
        return self.results.pop(0)


def lost_pilot(*results: Found | None) -> Pilot[Any]:
    """A pilot that is lost at rest, and a search of known results."""
    believed, sigma = np.array([2.0, 6.5, 0.0]), np.array([0.02, 0.02, 0.01])
    pilot = make_pilot("sequential", HALL, maps.field(HALL), "ipm", ControllerSettings(), believed, sigma, BEAMS)
    for _ in range(3):
        pilot.supervisor.judge({"fix": 2.0})
    assert pilot.verdict.health is Health.LOST
    pilot._search = Finding(*results)  # type: ignore[assignment]
    return pilot


def test_a_place_that_was_found_moves_on_by_the_wheels_and_has_to_fit_still() -> None:
    at, wheels = np.array([24.0, 5.5, -2.9]), np.array([0.3, 0.1])
    pilot = lost_pilot(*[None] * 39, Found(at, 1.0, "", (at,)))
    pilot._creeping, now = Creeping(), at.copy()
    for _ in range(40):
        now = pilot.controller.settings.kind.step(now[None], wheels[None], DT)[0]
        pilot._find_again(World(HALL, tuple(now.tolist())).scan(), wheels)
    assert np.hypot(*(now - at)[:2]) > 1.0 and pilot.relocated and not pilot.creeping
    np.testing.assert_allclose(pilot.pose, now, atol=0.05)
    elsewhere = np.array([3.0, 7.0, 1.0])
    pilot = lost_pilot(Found(elsewhere, 1.0, "", (elsewhere,)))
    pilot._find_again(World(HALL, tuple(at.tolist())).scan(), np.zeros(2))
    assert not pilot.relocated and np.hypot(*(pilot.pose - elsewhere)[:2]) > 0.5


def test_creeping_goes_straight_on_and_turns_to_where_there_is_room() -> None:
    creeping, bound = Creeping(), 0.34
    speed, turn = creeping.control(World(HALL, (13.0, 3.5, 0.0)).scan(), bound)
    assert speed > 0.0 and abs(turn) < 0.1, "along the aisle"
    for heading in (-0.35, 0.35):
        speed, turn = Creeping().control(World(HALL, (13.0, 3.5, heading)).scan(), bound)
        assert speed > 0.0 and -turn * heading > 0.07, "towards the direction of the aisle, not from wall to wall"
    corner = World(HALL, (25.0, 7.2, 0.0)).scan()  # walls ahead and to the left
    speed, turn = creeping.control(corner, bound)
    assert speed == 0.0 and turn < -0.3
    creeping.moved(np.array([0.0, -1.5]))
    assert creeping.control(World(HALL, (25.0, 7.2, -1.5)).scan(), bound)[0] > 0.0, "turned, it goes on"
    assert abs(creeping.control(World(HALL, (13.0, 3.5, 0.0)).scan(), bound)[1]) < 0.1
    creeping.blocked()
    speed, turn = creeping.control(World(HALL, (13.0, 3.5, 0.0)).scan(), bound)
    assert speed == 0.0 and abs(turn) > 0.3, "back, the way it came"
    assert not creeping.ended
    creeping.moved(np.array([-30.0, 0.0]))
    assert creeping.ended, "a way that never ends is no way"


def test_other_places_are_tried_seldom_once_nothing_fits_for_long(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lost robot's tick is spent on the search of the map; a scan that fits brings the hypotheses back."""
    field, here = maps.field(HALL), np.array([13.0, 3.5, 0.0])
    localiser = Localiser(field, here, np.full(3, 0.02), BEAMS)
    tried = list[int]()
    spread_out = localiser.spread_out

    def counted(scan: Scan, believed: Sequence[Hypothesis] = ()) -> None:
        tried[-1] += 1
        spread_out(scan, believed)

    monkeypatch.setattr(localiser, "spread_out", counted)

    def corrects(scan: Scan, count: int, least: float = 0.0) -> list[int]:
        tried.clear()
        for _ in range(count):
            tried.append(0)
            localiser.covariance = localiser.covariance + least * np.eye(3)
            localiser.correct(scan)
        return [min(number, 1) for number in tried]

    wrong, right = among_people(World(HALL, (24.0, 7.0, 1.0)).scan()), World(HALL, tuple(here.tolist())).scan()
    assert explained(field, wrong, here).share < FITS
    assert corrects(wrong, 31) == [1] * 10 + [1, 0, 0, 0, 0] * 4 + [1]
    localiser.reset(here, np.full(3, 0.02))
    assert corrects(wrong, 16, least=1.0) == [1] * 10 + [1, 0, 0, 0, 0, 1], "unsure or not"
    localiser.reset(here, np.full(3, 0.02))
    assert corrects(wrong, 1) == [1] and corrects(right, 1) == [0] and corrects(wrong, 11) == [1] * 11


def test_creeping_of_a_car_goes_back_where_it_cannot_turn() -> None:
    creeping, bound = Creeping(0.44), 0.34
    speed, turn = creeping.control(World(HALL, (13.0, 3.5, 0.1)).scan(), bound)
    assert speed > 0.0 and -0.7 < turn < 0.0
    for corner in ((25.0, 7.2, 0.0), (25.3, 3.5, 0.1)):  # a wall ahead: what is free aside is out of its reach
        creeping = Creeping(0.44)
        speed, turn = creeping.control(World(HALL, corner).scan(), bound)
        assert speed < 0.0 and abs(turn) <= 0.5
        assert creeping.control(World(HALL, corner).scan(), bound)[0] < 0.0, "it stays with that"
    creeping.blocked()
    creeping.moved(np.array([-10.0, 0.0]))
    assert creeping.travelled == 10.0 and abs(creeping._heading) < 0.7
    base = ackermann(0.3, 0.6)
    for speed in (0.3, -0.3):
        assert base.of(np.array([speed, base.turning(0.2, speed)]))[-1] == pytest.approx(0.2)
    assert base.turning(5.0, 0.3) == 0.6 and base_of("unicycle").turning(0.2, 0.0) == 0.2


@pytest.mark.product(1, of="drives and flights")
@pytest.mark.parametrize("base", ["unicycle", "ackermann"])
def test_a_robot_lost_in_an_aisle_creeps_to_its_end_and_finds_itself(base: str, tmp_path: Path) -> None:
    save_map(tmp_path / "hall.yaml", HALL)
    settings = NavigationSettings(
        map=tmp_path / "hall.yaml",
        start=(19.5, 3.5, 0.0),
        believed=(2.0, 6.5, 0.0),
        goals=((2.0, 1.0, 3.0),),
        obstacles=0,
        controller=ControllerSettings(base=base),
    )
    episode = Episode(settings)
    log = episode.run(maps.stop_after(150))
    assert abs(episode.pilot.calibration.state[BIAS]) < 0.003, "a lost robot learns nothing of its lidar"
    away = np.hypot(*(log.estimate - log.true_pose)[:, :2].T)
    creeping = np.array([status == "creeping" for status in log.status])
    assert away[0] > 10.0 and away[-1] < 0.05 and log.health[-1] == "ok" and log.collisions == 0
    assert 40 < creeping.sum() < 120 and np.ptp(log.true_pose[creeping, 0]) > 1.5
    assert np.abs(log.control[creeping, 0]).max() < 0.31 and not log.emergency[creeping].any()


@pytest.mark.product(1, of="drives and flights")
def test_a_robot_whose_scan_fits_another_place_better_is_lost() -> None:
    """Half of the beams end where the map says, as among people, too: that alone leaves it driving slowly."""
    field, where = maps.field(HALL), np.array([22.6, 3.5, -2.5])
    believed, settings = np.array([10.8, 0.99, 0.72]), ControllerSettings()
    sigma, ramp = np.array([0.02, 0.02, 0.01]), RAMPS["elsewhere"]
    sample = World(HALL, tuple(where.tolist())).scan()
    for scan, pose, elsewhere in ((sample, believed, True), (among_people(sample), where, False)):
        pilot = make_pilot("sequential", HALL, field, "ipm", settings, pose, sigma, BEAMS)
        pilot.share = explained(field, scan, pose).share
        assert 1.0 - pilot.share < RAMPS["unexplained"].lost and ramp.share(pilot._elsewhere) == 1.0
        for _ in range(100):
            pilot._find_again(scan, np.zeros(2))
            if pilot._elsewhere:
                break
        assert (pilot._elsewhere > ramp.lost) == elsewhere, pilot._elsewhere
        pilot.share = 1.0
        pilot._find_again(scan, np.zeros(2))
        assert pilot._elsewhere == 0.0, "a scan that fits leaves nothing to look for"


@pytest.mark.parametrize(("fitting", "elsewhere"), [(0.8, 0.0), (0.9, 0.45)])
def test_a_place_that_fits_badly_itself_is_no_better_one(fitting: float, elsewhere: float) -> None:
    pilot, sample = lost_pilot(), World(HALL, (22.6, 3.5, -2.5)).scan()
    pilot.supervisor.verdict = HealthReport(Health.OK, 1.0, "")
    pilot._search = Finding(*[Found(None, fitting, "")] * DOUBTFUL)  # type: ignore[assignment]
    pilot.share = 0.45
    for _ in range(DOUBTFUL):
        pilot._find_again(sample, np.zeros(2))
    assert pilot._elsewhere == pytest.approx(elsewhere)


def test_a_map_put_askew_leaves_the_robot_in_the_open() -> None:
    occupancy, field = maps.building()
    here = np.array([10.8, 17.0, 0.3])
    other = askew(occupancy, here)
    turned = maps.field(other)
    assert turned.distance(here[None, :2])[0] == pytest.approx(field.distance(here[None, :2])[0], abs=0.03)
