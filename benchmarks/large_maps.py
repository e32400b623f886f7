"""Maps as large as the paper's robots had, and one of five hundred metres, drawn from a few numbers and a seed.

    python -m benchmarks.large_maps                  draws the maps of benchmarks/campaigns again
    python -m benchmarks.large_maps --measure 500    what a map of 500 m costs: time of the processor, and memory
    python -m benchmarks.large_maps --drive 500      a whole drive through it: ticks, way, memory

Bazzana et al. 2022 drive 30 times along eight legs of their department (Table I: four of about 170 m, two of 91, two
of 18) and four legs of a factory-like map (Table II: 154, 87, 142 and 131 m). Neither map is published with
coordinates, so these are made to the lengths: a floor of three long corridors with a room behind every door, and a hall
of aisles between racks with gates and one strip of rooms. Furniture is random, so that a lidar can tell places apart.
"""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.report import command
from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap, save_map
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.log.drive_metrics import episode_metrics
from unifg.scenarios.navigation import NavigationSettings, run_navigation
from unifg.scenarios.planning.grid import plan
from unifg.scenarios.planning.polyline import path_length
from unifg.scenarios.simulation.rectangles import wall_rectangles
from unifg.typing import BoolArray

CAMPAIGNS = Path(__file__).resolve().parent / "campaigns"
RESOLUTION = 0.05  # [m]
MARGIN = 1.0  # [m] of unknown around everything
WALL = 0.2  # [m]
CORRIDOR, DEEP = 2.4, 6.0  # [m]: width of corridors, depth of rooms
DOOR = (0.9, 1.1)  # [m]
ROOM = (4.0, 8.0)  # [m] along the corridor
AISLE = 3.2  # [m] between racks


@dataclass(frozen=True)
class Room:
    """A place to go to: the middle of what is left free behind a door.

    Attributes:
        x: [m].
        y: [m].
        heading: out of the door [rad].
    """

    x: float
    y: float
    heading: float


class Drawing:
    """Boxes in metres on a grid."""

    def __init__(self, width: float, height: float, seed: int) -> None:
        """Begin with nothing known."""
        shape = round(height / RESOLUTION), round(width / RESOLUTION)
        self.free, self.occupied = np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        self.rng = np.random.default_rng(seed)
        self.rooms: list[Room] = []

    def wall(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Fill a box."""
        self._paint(self.occupied, x0, y0, x1, y1, True)

    def open(self, x0: float, y0: float, x1: float, y1: float) -> None:
        """Make a box free floor, whatever stood there."""
        self._paint(self.occupied, x0, y0, x1, y1, False)
        self._paint(self.free, x0, y0, x1, y1, True)

    def map(self, name: str) -> OccupancyMap:
        """The map, with its origin a margin outside of everything."""
        return OccupancyMap(self.occupied, self.free & ~self.occupied, RESOLUTION, (-MARGIN, -MARGIN, 0.0), name)

    def _paint(self, grid: BoolArray, x0: float, y0: float, x1: float, y1: float, value: bool) -> None:
        rows, columns = (
            slice(max(0, round((low + MARGIN) / RESOLUTION)), max(0, round((high + MARGIN) / RESOLUTION)))
            for low, high in (sorted((y0, y1)), sorted((x0, x1)))
        )
        grid[rows, columns] = value


class Strip:
    """Rooms along one side of a corridor, drawn in its own directions: ``u`` along it, ``v`` away from it."""

    def __init__(self, drawing: Drawing, begin: tuple[float, float], along: str, side: int) -> None:
        """Begin at a corner of the corridor; ``along`` is "x" or "y", ``side`` +1 or -1."""
        self.drawing, self.begin, self.along, self.side = drawing, begin, along, side

    def draw(self, length: float, deep: float = DEEP) -> None:
        """Fill a length with rooms."""
        rng, u = self.drawing.rng, 0.0
        self._open(0.0, 0.0, length, deep)
        self._wall(0.0, -WALL / 2, length, WALL / 2)
        self._wall(0.0, deep - WALL, length, deep)
        while u < length - 1e-9:
            width = float(rng.uniform(*ROOM))
            width = length - u if length - u - width < ROOM[0] else width
            self._room(u, width, deep)
            u += width
        self._wall(length - WALL / 2, 0.0, length + WALL / 2, deep)

    def _room(self, u: float, width: float, deep: float) -> None:
        rng = self.drawing.rng
        self._wall(u - WALL / 2, 0.0, u + WALL / 2, deep)
        door = float(rng.uniform(*DOOR))
        at = float(rng.uniform(u + 0.6, u + width - door - 0.6))
        self._open(at, -WALL / 2, at + door, WALL / 2)
        hinge = at if rng.random() < 0.5 else at + door  # the leaf stands open, one cell thick, beside the opening
        leaf = (hinge - RESOLUTION, hinge) if hinge == at else (hinge, hinge + RESOLUTION)
        self._wall(leaf[0], WALL / 2, leaf[1], WALL / 2 + door)
        for _ in range(int(rng.integers(3, 7))):  # along the walls, so that the middle and the door stay free
            wide, thick = float(rng.uniform(0.5, min(2.2, 0.5 * width))), float(rng.uniform(0.4, 0.8))
            place = int(rng.integers(3))
            if place == 0:  # at the far wall
                left = float(rng.uniform(u + WALL, u + width - WALL - wide))
                self._wall(left, deep - WALL - thick, left + wide, deep - WALL)
            else:  # at the walls to the neighbours, away from the door
                low = float(rng.uniform(1.8, deep - WALL - 0.9))
                inner, outer = (u, u + thick) if place == 1 else (u + width - thick, u + width)
                self._wall(inner, low, outer, min(low + wide, deep - WALL))
        x, y = self._at(at + door / 2, 0.72 * deep)
        mid_x, mid_y = self._at(u + width / 2, 0.72 * deep)
        out = math.pi if self.side > 0 else 0.0
        turn = out - math.pi / 2 if self.along == "x" else out
        heading = turn if self.along == "y" else -self.side * math.pi / 2
        self.drawing.rooms.append(Room(round((x + mid_x) / 2, 2), round((y + mid_y) / 2, 2), round(heading, 4)))

    def _at(self, u: float, v: float) -> tuple[float, float]:
        x, y = self.begin
        return (x + u, y + self.side * v) if self.along == "x" else (x + self.side * v, y + u)

    def _wall(self, u0: float, v0: float, u1: float, v1: float) -> None:
        self.drawing.wall(*self._at(u0, v0), *self._at(u1, v1))

    def _open(self, u0: float, v0: float, u1: float, v1: float) -> None:
        self.drawing.open(*self._at(u0, v0), *self._at(u1, v1))


def department() -> tuple[OccupancyMap, list[Room]]:
    """A floor of three corridors in the shape of a U, 175 m from end to end, rooms on both sides, and those rooms."""
    side, across = 64.0, 58.0
    left, right = DEEP, DEEP + across
    drawing = Drawing(right + DEEP + 2.0 * MARGIN, side + DEEP + 2.0 * MARGIN, seed=7)
    half = CORRIDOR / 2
    drawing.open(left - half, 0.0, left + half, side + half)
    drawing.open(right - half, 0.0, right + half, side + half)
    drawing.open(left - half, side - half, right + half, side + half)
    inside = DEEP + WALL
    Strip(drawing, (left - half, 0.0), "y", -1).draw(side - 8.0, DEEP - half)
    Strip(drawing, (left + half, 0.0), "y", +1).draw(side - inside - half - 2.0)
    Strip(drawing, (right - half, 0.0), "y", -1).draw(side - inside - half - 2.0)
    Strip(drawing, (right + half, 0.0), "y", +1).draw(side - 8.0, DEEP - half)
    Strip(drawing, (left + half + 2.0, side - half), "x", -1).draw(across - CORRIDOR - 4.0)
    Strip(drawing, (left + half + 2.0, side + half), "x", +1).draw(across - CORRIDOR - 4.0, DEEP - half)
    for x, outer, inner in ((left, left - half - WALL, left + half), (right, right + half, right - half - WALL)):
        drawing.wall(x - half - WALL / 2, -WALL / 2, x + half + WALL / 2, WALL / 2)
        drawing.wall(outer, side - 8.0, outer + WALL, side + half)
        drawing.wall(inner, side - inside - half - 2.0, inner + WALL, side - half)
        drawing.wall(x - half - WALL, side + half, x + half + WALL, side + half + WALL)
    for x in (left + half, right - half - 2.0):
        drawing.wall(x, side + half, x + 2.0, side + half + WALL)
        drawing.wall(x, side - half - WALL, x + 2.0, side - half)
    _clutter(drawing, [((left - half, 1.0), "y", side - 6.0), ((right - half, 1.0), "y", side - 6.0)])
    _clutter(drawing, [((left + 3.0, side - half), "x", across - 6.0)])
    return drawing.map("department"), drawing.rooms


def factory() -> tuple[OccupancyMap, list[Room]]:
    """A hall of 136 m by 76 m: racks with aisles of 3.2 m, machines, walls with gates, rooms along one side."""
    wide, high, middle, across = 136.0, 76.0, 64.0, 38.0
    drawing = Drawing(wide + 2.0 * MARGIN, high + DEEP + 2.0 * MARGIN, seed=11)
    drawing.open(0.0, 0.0, wide, high)
    for box in ((0, 0, wide, WALL), (0, 0, WALL, high), (wide - WALL, 0, wide, high)):
        drawing.wall(*map(float, box))
    Strip(drawing, (0.0, high), "x", +1).draw(wide)
    places = [*_racks(drawing, 3.0, 3.5, middle - 4.0, high - 6.0)]
    places += _machines(drawing, middle + 4.0, 3.5, wide - 4.0, across - 3.0)
    places += _racks(drawing, middle + 4.0, across + 3.0, wide - 4.0, high - 6.0)
    drawing.wall(middle, 0.0, middle + WALL, high)  # three halls, with gates and two doors
    drawing.wall(middle, across, wide, across + WALL)
    for x0, y0, x1, y1 in (
        (middle, 9.0, middle + WALL, 11.4),
        (middle, high - 4.0, middle + WALL, high - 3.0),
        (wide - 8.0, across, wide - 5.6, across + WALL),
        (wide - 16.0, across, wide - 15.0, across + WALL),
    ):
        drawing.open(x0, y0, x1, y1)
    return drawing.map("factory"), [*drawing.rooms, *places]


def town(side: float = 500.0) -> tuple[OccupancyMap, list[Room]]:
    """A map of ``side`` by ``side`` [m]: corridors every thirty metres both ways, rooms along those to the east."""
    drawing = Drawing(side, side, seed=3)
    reach, pitch = side - 2.0 * MARGIN, 30.0
    lines = np.arange(CORRIDOR, reach - CORRIDOR, pitch)
    for y in lines[:-1]:
        for first in lines[:-1]:
            begin, length = first + CORRIDOR / 2 + WALL, pitch - CORRIDOR - 2.0 * WALL
            Strip(drawing, (begin, y + CORRIDOR / 2), "x", +1).draw(length)
            drawing.wall(first + CORRIDOR / 2, y + CORRIDOR / 2, begin, y + pitch - CORRIDOR / 2)
            drawing.wall(begin + length, y + CORRIDOR / 2, begin + length + WALL, y + pitch - CORRIDOR / 2)
    for line in lines:
        drawing.open(line - CORRIDOR / 2, lines[0] - CORRIDOR / 2, line + CORRIDOR / 2, lines[-1] + CORRIDOR / 2)
        drawing.open(lines[0] - CORRIDOR / 2, line - CORRIDOR / 2, lines[-1] + CORRIDOR / 2, line + CORRIDOR / 2)
    low, high = lines[0] - CORRIDOR / 2, lines[-1] + CORRIDOR / 2
    for box in (
        (low - WALL, low - WALL, high + WALL, low), (low - WALL, high, high + WALL, high + WALL),
        (low - WALL, low, low, high), (high, low, high + WALL, high),
    ):  # fmt: skip
        drawing.wall(*map(float, box))
    _clutter(drawing, [((float(first), float(y) - CORRIDOR / 2), "x", pitch) for y in lines for first in lines[:-1]])
    return drawing.map("town"), drawing.rooms


def _clutter(drawing: Drawing, corridors: list[tuple[tuple[float, float], str, float]]) -> None:
    """Cabinets and pilasters at the walls of corridors."""
    for (x, y), along, length in corridors:
        u = 0.0
        while (u := u + float(drawing.rng.uniform(2.5, 7.0))) < length - 2.0:
            long, deep = float(drawing.rng.uniform(0.3, 1.6)), float(drawing.rng.uniform(0.15, 0.4))
            v = 0.0 if drawing.rng.random() < 0.5 else CORRIDOR - deep
            box = (x + u, y + v, x + u + long, y + v + deep)
            drawing.wall(*(box if along == "x" else (x + v, y + u, x + v + deep, y + u + long)))


def _racks(drawing: Drawing, x0: float, y0: float, x1: float, y1: float) -> Iterator[Room]:
    """Rows of racks from west to east, broken here and there; yields places in the aisles."""
    y = y0
    while y + 1.1 < y1:
        x = x0 + float(drawing.rng.uniform(0.0, 2.0))
        while x < x1 - 4.0:
            long = min(float(drawing.rng.uniform(6.0, 15.0)), x1 - x)
            drawing.wall(x, y, x + long, y + 1.1)
            x += long + float(drawing.rng.uniform(1.2, 3.0))
        for place in np.linspace(x0 + 2.0, x1 - 2.0, 4):
            yield Room(round(float(place), 2), round(y + 1.1 + AISLE / 2, 2), 0.0)
        y += 1.1 + AISLE


def _machines(drawing: Drawing, x0: float, y0: float, x1: float, y1: float) -> Iterator[Room]:
    """Blocks of all sizes with ways between them; yields places in these."""
    step = 7.5
    for x in np.arange(x0, x1 - 4.0, step):
        for y in np.arange(y0, y1 - 4.0, step):
            w, h = drawing.rng.uniform(2.0, 5.4, 2)
            dx, dy = drawing.rng.uniform(0.0, 0.6, 2)
            drawing.wall(x + dx, y + dy, x + dx + w, y + dy + h)
            yield Room(round(float(x) + 6.6, 2), round(float(y) + 6.6, 2), 0.0)


def measured(side: float) -> Iterator[str]:
    """Draw a town, measure its distances, find its walls' rectangles and a way from one end to the other."""
    began = time.process_time()

    def told(what: str) -> str:
        nonlocal began
        took, began = time.process_time() - began, time.process_time()
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        return f"{what}: {took:.1f} s of the processor, at most {peak:.2f} GB so far"

    occupancy, rooms = town(side)
    yield told(f"{occupancy.occupied.size / 1e6:.1f} million cells, {occupancy.free.sum() / 1e6:.1f} of them free")
    field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
    yield told("distance field")
    yield told(f"{len(wall_rectangles(occupancy.occupied))} rectangles of walls")
    standing = [room for room in rooms if field.distance(np.array([room.x, room.y])) > 0.3]
    for first, last in product(standing[:6], standing[:-7:-1]):
        try:  # furniture shuts some rooms
            path = plan(occupancy, field, (first.x, first.y), (last.x, last.y, 0.0), robot_radius=0.17)
        except ScenarioError:
            continue
        yield told(f"a way of {path_length(path):.0f} m")
        return


def driven(side: float) -> Iterator[str]:
    """Drive a whole way through a town, from one end to the other: ticks and memory, quarter by quarter."""
    with TemporaryDirectory() as folder:
        occupancy, rooms = town(side)
        save(Path(folder) / "town.yaml", occupancy)
        field = DistanceMap.from_occupancy(occupancy.occupied, occupancy.resolution, occupancy.origin)
        standing = [room for room in rooms if field.distance(np.array([room.x, room.y])) > 0.3]
        for first, last in product(standing[:6], standing[:-7:-1]):
            try:
                path = plan(occupancy, field, (first.x, first.y), (last.x, last.y, 0.0), robot_radius=0.17)
            except ScenarioError:
                continue
            break
        else:
            raise ScenarioError("no two rooms of this town are joined")
        start = (first.x, first.y, float(path[0, 2]))
        goal = (last.x, last.y, float(path[-2, 2]))
        del field
        began, ends = time.process_time(), list[float]()
        log = run_navigation(
            NavigationSettings(map=Path(folder) / "town.yaml", start=start, goals=(goal,)),
            lambda done, text: ends.append(time.process_time()),
        )
    spent = time.process_time() - began
    metrics = episode_metrics(log)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    yield (
        f"{occupancy.occupied.size / 1e6:.1f} million cells: {', '.join(log.outcomes)}, {log.collisions} contacts, "
        f"{metrics['path_length_m']:.0f} m in {metrics['duration_s']:.0f} s, localisation "
        f"{1e3 * metrics['localisation_error_m']['mean']:.1f} mm on average; {spent:.0f} s of the processor with "
        f"reading the map, at most {peak:.2f} GB"
    )
    quarters = zip(np.array_split(log.tick_ms, 4), np.array_split(1e3 * np.diff(ends[:-1]), 4), strict=True)
    for number, (quarter, processor) in enumerate(quarters, start=1):
        p50, p99 = np.percentile(quarter, [50.0, 99.0])
        yield (
            f"quarter {number}: tick median {p50:.1f} ms, 99 % {p99:.1f} ms, at most {quarter.max():.1f} ms; "
            f"with world and lidar {np.median(processor):.2f} ms of the processor, {processor.mean():.2f} on average"
        )


def main(arguments: list[str] | None = None) -> int:
    """Draw the maps of the campaigns, or measure a large one."""
    parser = command(__doc__)
    parser.add_argument("--measure", type=float, metavar="SIDE", help="of a town [m]; draws no map of the campaigns")
    parser.add_argument("--drive", type=float, metavar="SIDE", help="through such a town, from end to end [m]")
    options = parser.parse_args(arguments)
    if options.measure is not None or options.drive is not None:
        for line in measured(options.measure) if options.measure is not None else driven(options.drive):
            print(line, flush=True)
        return 0
    CAMPAIGNS.mkdir(exist_ok=True)
    for draw in (department, factory):
        occupancy, _ = draw()
        save(CAMPAIGNS / f"{occupancy.name}.yaml", occupancy)
    return 0


def save(path: Path, occupancy: OccupancyMap) -> None:
    """Write a ROS map whose image is a PNG, a hundredth of what it takes plain."""
    from PIL import Image

    save_map(path, occupancy)
    plain = path.with_suffix(".pgm")
    Image.MAX_IMAGE_PIXELS = None  # five hundred metres are a hundred million
    with Image.open(plain) as image:
        image.save(path.with_suffix(".png"), optimize=True)
    plain.unlink()
    path.write_text(path.read_text(encoding="utf-8").replace(plain.name, f"{path.stem}.png"), encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
