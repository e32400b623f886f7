"""What goes about in a building besides the robot: people, carts and doors.

People walk to and fro along a way, at a pace of their own: either strictly (``scripted``), or by social forces
(Helbing, Farkas, Vicsek, Nature 407 (2000), eqs. 1 to 3 without those of touching bodies): they want to go on at their
pace, and keep off walls and each other. Carts are boxes, longer than wide, that are pushed to and fro. Doors are leaves
that slide across a narrow place, open and closed by a schedule.

None of them waits for the robot unless they are courteous: people then feel it as they feel each other, carts stop
before it. Doors have an edge that feels: none closes on a robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pymunk

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.options import count, option, positive
from unifg.scenarios.ways.grid import path_exists
from unifg.scenarios.ways.polyline import arc_lengths, at_stations
from unifg.typing import Array, BoolArray

__all__ = ["Cart", "Door", "Fellow", "Person", "Schedule", "Traffic", "draw_traffic", "moved"]

RELAXATION = 0.5  # [s], of a person's velocity to the one that is wanted
PUSH, REACH = 25.0, 0.08  # of a person: acceleration at a touch [m/s^2], length over which it falls to 1/e [m]
HASTE = 1.3  # fastest walk, in shares of the pace that is wanted
MOST = 200  # people, carts or doors
CARROT = 0.5  # [m] ahead on their way that people go for
BEFORE = 0.1  # [m] before the robot that a courteous cart stops
SAFE = 0.1  # [m] around a door's leaf in which it feels a robot
SLIDING = 1.0  # [s] that a door takes to open or to close
THICK = 0.06  # [m], of a door's leaf
DOORWAY = (0.35, 0.85)  # from its middle to both sides: what counts as a place for a door [m]
APART = 1.0  # [m] between the middles of two doors
FROM_START, FROM_GOAL = 3.0, 1.2  # [m], where nobody is at the beginning, and where no door is
PERSON = (0.18, 0.25)  # radius [m]
CART = (1.2, 0.6)  # length and width [m]
WALK = (3.0, 10.0)  # shortest and longest way of a person or a cart [m]
STEP = 0.1  # [m] between places that are tried
DRAWS = 200  # of each
WAY = 0.25  # clearance of the ways that carts leave, wherever they are [m]


@dataclass(frozen=True)
class Traffic:
    """Who goes about in the building; nobody by default.

    Attributes:
        people: number of people who walk along the planned path.
        walking: how they walk: by social forces, or strictly along their way.
        slowest: least pace of a person; each draws one between this and ``fastest`` [m/s].
        fastest: [m/s].
        carts: number of carts, of 1.2 m by 0.6 m, that are pushed along the planned path.
        cart_speed: [m/s].
        doors: number of doors in narrow places of the planned path.
        open_for: time for which a door is wholly open [s].
        closed_for: time for which it is wholly closed [s].
    """

    people: int = option(0, text=partial(count, most=MOST), metavar="K")
    walking: str = option("social", choices=("social", "scripted"))
    slowest: float = option(0.3, text=positive, metavar="M/S", flag="people-slowest")
    fastest: float = option(1.5, text=positive, metavar="M/S", flag="people-fastest")
    carts: int = option(0, text=partial(count, most=MOST), metavar="K")
    cart_speed: float = option(0.5, text=positive, metavar="M/S")
    doors: int = option(0, text=partial(count, most=MOST), metavar="K")
    open_for: float = option(8.0, text=positive, metavar="S", flag="doors-open")
    closed_for: float = option(4.0, text=positive, metavar="S", flag="doors-closed")

    def __post_init__(self) -> None:
        """Refuse what nobody is.

        Raises:
            ScenarioError: naming the field.
        """
        if self.walking not in ("social", "scripted"):
            raise ScenarioError(f"unknown way of walking '{self.walking}': choose social or scripted")
        if not 0.0 < self.slowest <= self.fastest < math.inf:
            raise ScenarioError(f"people walk at 0 < slowest <= fastest, got {self.slowest:g} and {self.fastest:g} m/s")
        for name in ("people", "carts", "doors"):
            if not 0 <= getattr(self, name) <= MOST:
                raise ScenarioError(f"the number of {name} must be from 0 to {MOST}, got {getattr(self, name)}")
        for name in ("cart_speed", "open_for", "closed_for"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ScenarioError(f"{name} must be above zero and finite, got {getattr(self, name)}")


class Person:
    """A disc that walks to and fro along a way.

    Attributes:
        body: kinematic; where it is, and its velocity.
        others: bodies and radii that it keeps off, by social forces.
    """

    def __init__(
        self, way: Array, radius: float, pace: float, walls: DistanceMap | None = None, courteous: bool = False
    ) -> None:
        """Stand at the beginning of a way.

        Args:
            way: (P, 2) [m].
            radius: [m].
            pace: at which it wants to walk [m/s].
            walls: distance to them, for social forces; None walks strictly along the way.
            courteous: whether it keeps off the robot, too, which strict walkers never do.
        """
        self.way, self.radius, self.pace, self.courteous = way, radius, pace, courteous
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.body.position = (float(way[0, 0]), float(way[0, 1]))
        self.shape = pymunk.Circle(self.body, radius)
        self.others: list[tuple[pymunk.Body, float]] = []
        self._walls, self._arc = walls, arc_lengths(way)
        self._along, self._sense = 0.0, 1.0

    def advance(self, robot: pymunk.Body, robot_radius: float, resting: bool, dt: float) -> None:
        """Choose the velocity of the next ``dt`` [s]."""
        if self._walls is None:
            self._go_on(self.pace * dt)
            target = at_stations(self.way, self._arc, np.array([self._along]))[0]
            self.body.velocity = ((target[0] - self.body.position.x) / dt, (target[1] - self.body.position.y) / dt)
            return
        place, velocity = np.array(self.body.position), np.array(self.body.velocity)
        velocity = velocity + dt * self.force(place, velocity, (robot, robot_radius) if self.courteous else None)
        speed = float(np.hypot(*velocity))
        velocity *= min(1.0, HASTE * self.pace / max(speed, 1e-12))
        self.body.velocity = (float(velocity[0]), float(velocity[1]))

    def force(self, place: Array, velocity: Array, robot: tuple[pymunk.Body, float] | None = None) -> Array:
        """(2,) acceleration at a place (2,) and velocity (2,), between what is wanted and what is kept off [m/s^2]."""
        carrot = at_stations(self.way, self._arc, np.array([self._along]))[0] - place
        # Once to and fro: of a way that bends or is short, no point may be far enough.
        for _ in range(math.ceil(2.0 * float(self._arc[-1]) / STEP)):
            if float(np.hypot(*carrot)) >= CARROT:
                break
            self._go_on(STEP)
            carrot = at_stations(self.way, self._arc, np.array([self._along]))[0] - place
        made: Array = (self.pace * carrot / max(float(np.hypot(*carrot)), 1e-6) - velocity) / RELAXATION
        for body, radius in [*self.others, *([] if robot is None else [robot])]:
            away = place - np.array(body.position)
            distance = max(float(np.hypot(*away)), 1e-6)
            made += PUSH * math.exp((self.radius + radius - distance) / REACH) * away / distance
        if self._walls is not None:
            off_walls, slope = self._walls.distance_and_gradient(place)
            made += PUSH * math.exp(min((self.radius - float(off_walls)) / REACH, 1.0)) * slope
        return made

    def _go_on(self, length: float) -> None:
        """Move the place on the way that is gone for, turning round at its ends."""
        along, most = self._along + self._sense * length, float(self._arc[-1])
        if not 0.0 <= along <= most:
            self._sense = -self._sense
            along = float(np.clip(2.0 * most - along if along > most else -along, 0.0, most))
        self._along = along


class Cart:
    """A box that is pushed to and fro along its longer side.

    Attributes:
        body: kinematic.
        size: (length, width) [m].
    """

    def __init__(
        self, begin: Array, end: Array, speed: float, size: tuple[float, float] = CART, courteous: bool = False
    ) -> None:
        """Stand at the beginning, about to leave for the end, (2,) both [m], at a speed [m/s]."""
        self.size, self.speed, self.courteous = size, speed, courteous
        self._begin, span = np.asarray(begin, dtype=np.float64), np.asarray(end, dtype=np.float64) - begin
        self._length = float(np.hypot(*span))
        self._direction = span / self._length
        self._along, self._sense = 0.0, 1.0
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.body.position = (float(begin[0]), float(begin[1]))
        self.body.angle = math.atan2(self._direction[1], self._direction[0])
        self.shape = pymunk.Poly.create_box(self.body, size)

    def advance(self, robot: pymunk.Body, robot_radius: float, resting: bool, dt: float) -> None:
        """Choose the velocity of the next ``dt`` [s]."""
        along, sense = self._along + self._sense * self.speed * dt, self._sense
        if not 0.0 <= along <= self._length:
            along, sense = (2.0 * self._length - along if along > self._length else -along), -sense
        target = self._begin + along * self._direction
        if self.courteous and self._would_crowd(target, robot, robot_radius):
            self.body.velocity = (0.0, 0.0)
            return
        self._along, self._sense = along, sense
        self.body.velocity = ((target[0] - self.body.position.x) / dt, (target[1] - self.body.position.y) / dt)

    def _would_crowd(self, target: Array, robot: pymunk.Body, robot_radius: float) -> bool:
        """Whether it would come so near to the robot at a place (2,), and nearer than it is."""
        here, there = (
            gap_to_box(np.array(robot.position) - place, self.body.angle, self.size) - robot_radius
            for place in (np.array(self.body.position), target)
        )
        return there < min(BEFORE, here)


class Fellow:
    """The robot of another world, as this one meets it: a disc that is where that one is.

    Attributes:
        body: kinematic.
        radius: [m].
    """

    def __init__(self, robot: pymunk.Body, radius: float) -> None:
        """Stand where the other robot stands; ``radius`` is its own [m]."""
        self._robot, self.radius = robot, radius
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.body.position = robot.position
        self.shape = pymunk.Circle(self.body, radius)

    def advance(self, robot: pymunk.Body, robot_radius: float, resting: bool, dt: float) -> None:
        """Be where the other is by the end of the next ``dt`` [s]."""
        self.body.velocity = (self._robot.position - self.body.position) / dt


@dataclass(frozen=True)
class Schedule:
    """When a door is how far closed: open, closing, closed, opening, again and again.

    Attributes:
        open_for: time wholly open [s].
        closed_for: time wholly closed [s].
        sliding: time to open or to close [s].
        begun: time since it was last wholly open, at time zero [s].
    """

    open_for: float
    closed_for: float
    sliding: float = SLIDING
    begun: float = 0.0

    @property
    def period(self) -> float:
        """Of the whole [s]."""
        return self.open_for + self.closed_for + 2.0 * self.sliding

    def closed(self, time: float) -> float:
        """Share closed at a time [s]."""
        phase = (time + self.begun) % self.period
        if phase < self.open_for:
            return 0.0
        phase -= self.open_for
        return min(phase / self.sliding, 1.0, max(0.0, (self.closed_for + 2.0 * self.sliding - phase) / self.sliding))


class Door:
    """A leaf that slides across an opening; what would be squeezed makes its clock stand still.

    Attributes:
        body: kinematic; the middle of the leaf.
        size: (length, thickness) of the leaf, as long as the opening [m].
        time: of its clock [s].
    """

    def __init__(self, middle: Array, heading: float, width: float, schedule: Schedule) -> None:
        """Stand as the schedule has it at time zero.

        Args:
            middle: (2,) of the opening [m].
            heading: in which the leaf closes [rad].
            width: of the opening [m].
            schedule: of the door.
        """
        self.size, self.time = (width, THICK), 0.0
        self._middle, self._heading, self._schedule = np.asarray(middle, dtype=np.float64), heading, schedule
        self.body = pymunk.Body(body_type=pymunk.Body.KINEMATIC)
        self.body.angle = heading
        self.body.position = self._at(0.0)
        self.shape = pymunk.Poly.create_box(self.body, self.size)

    def _at(self, time: float) -> tuple[float, float]:
        """Middle of the leaf at a time of its clock."""
        back = (1.0 - self._schedule.closed(time)) * self.size[0]
        x, y = self._middle - back * np.array([math.cos(self._heading), math.sin(self._heading)])
        return float(x), float(y)

    def advance(self, robot: pymunk.Body, robot_radius: float, resting: bool, dt: float) -> None:
        """Choose the velocity of the next ``dt`` [s]."""
        before, after = self._schedule.closed(self.time), self._schedule.closed(self.time + dt)
        offset = np.array(robot.position) - self._middle
        if after > before and gap_to_box(offset, self._heading, self.size) - robot_radius < SAFE:
            self.body.velocity = (0.0, 0.0)
            return
        self.time += dt
        x, y = self._at(self.time)
        self.body.velocity = ((x - self.body.position.x) / dt, (y - self.body.position.y) / dt)


def gap_to_box(offset: Array, angle: float, size: tuple[float, float]) -> float:
    """Distance from a box, turned by an angle about its middle, to a point at an offset (2,) from there [m]."""
    cosine, sine = math.cos(angle), math.sin(angle)
    ahead, aside = cosine * offset[0] + sine * offset[1], cosine * offset[1] - sine * offset[0]
    return math.hypot(max(abs(ahead) - 0.5 * size[0], 0.0), max(abs(aside) - 0.5 * size[1], 0.0))


def draw_traffic(
    traffic: Traffic, occupancy: OccupancyMap, walls: DistanceMap, path: Array, goals: Array,
    rng: np.random.Generator, courteous: bool = False,
) -> list[Person | Cart | Door]:  # fmt: skip
    """Everybody, on or beside a planned path.

    Args:
        traffic: how many of whom.
        occupancy: the building.
        walls: distance to them.
        path: (P, 3) planned path, from the start over all goals.
        goals: (G, 3).
        rng: source of all numbers; each kind has a stream of its own.
        courteous: whether they mind the robot.

    Raises:
        ScenarioError: there is no place for so many.
    """
    of_people, of_carts, of_doors = rng.spawn(3)
    points = path[:, :2]
    people = [_person(traffic, walls, points, of_people, courteous) for _ in range(traffic.people)]
    for person in people:
        person.others = [(other.body, other.radius) for other in people if other is not person]
    carts = list[Cart]()
    for _ in range(traffic.carts):
        carts.append(_cart(traffic, occupancy, walls, path, goals, of_carts, courteous))
    return [*people, *carts, *_doors(traffic, walls, points, goals, of_doors)]


def _stretch(points: Array, rng: np.random.Generator) -> Array:
    """(Q, 2) a piece of a path that begins far from the robot, in one of both senses [m]."""
    arc = arc_lengths(points)
    where, length, back = rng.random(3)
    begin = FROM_START + where * max(float(arc[-1]) - FROM_START, 0.0)
    span = (WALK[0] + length * (WALK[1] - WALK[0])) * (1.0 if back < 0.5 else -1.0)
    end = float(np.clip(begin + span, 0.0, arc[-1]))
    stations = np.linspace(begin, end, max(2, round(abs(end - begin) / STEP) + 1))
    return at_stations(points, arc, stations)


def _person(traffic: Traffic, walls: DistanceMap, points: Array, rng: np.random.Generator, courteous: bool) -> Person:
    for _ in range(DRAWS):
        way, (size, pace, aside) = _stretch(points, rng), rng.random(3)
        radius = PERSON[0] + size * (PERSON[1] - PERSON[0])
        along = np.gradient(way, axis=0)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
        way = way + (aside - 0.5) * normal
        far = np.hypot(*(way[0] - points[0])) >= FROM_START
        if far and arc_lengths(way)[-1] > CARROT and walls.distance(way).min() >= radius + 0.02:
            speed = traffic.slowest + pace * (traffic.fastest - traffic.slowest)
            return Person(way, radius, float(speed), walls if traffic.walking == "social" else None, courteous)
    raise ScenarioError("there is no place for so many people along the path; ask for fewer, or for goals farther away")


def _cart(
    traffic: Traffic, occupancy: OccupancyMap, walls: DistanceMap, path: Array, goals: Array, rng: np.random.Generator,
    courteous: bool,
) -> Cart:  # fmt: skip
    length, width = CART
    outline = np.array([(a * length, b * width) for a in (-0.5, -0.25, 0.0, 0.25, 0.5) for b in (-0.5, 0.0, 0.5)])
    for _ in range(DRAWS):
        piece, aside = _stretch(path[:, :2], rng), rng.random() - 0.5
        span = piece[min(10, len(piece) - 1)] - piece[0]
        if float(np.hypot(*span)) < 0.5:
            continue
        heading = math.atan2(span[1], span[0])
        cosine, sine = math.cos(heading), math.sin(heading)
        turn = np.array([[cosine, -sine], [sine, cosine]])
        begin = piece[0] + turn @ np.array([0.0, 1.5 * aside])
        steps = np.arange(0.0, WALK[1], STEP)
        places = begin + steps[:, None] * turn[:, 0]
        free: BoolArray = walls.distance(places[:, None] + outline @ turn.T).min(axis=1) > 0.02
        reach = steps[int(np.argmin(free)) - 1] if free[0] and not free.all() else steps[-1] * bool(free[0])
        near = np.hypot(*(places[steps <= reach] - path[0, :2]).T).min(initial=0.0 if reach == 0.0 else math.inf)
        if reach < WALK[0] or near < FROM_START:
            continue
        end = begin + reach * turn[:, 0]
        discs = [(*(at + s * length * turn[:, 0]), 0.6 * width) for at in (begin, 0.5 * (begin + end), end)
                 for s in (-0.3, 0.0, 0.3)]  # fmt: skip
        ways = [np.array(discs[k : k + 3]) for k in (0, 3, 6)]
        if all(path_exists(occupancy, walls, path[0, :2], goal[:2], WAY, at) for at in ways for goal in goals):
            return Cart(begin, end, traffic.cart_speed, courteous=courteous)
    raise ScenarioError(
        f"there is no straight and wide piece of the path for so many carts of {length:g} m by {width:g} m; "
        "ask for fewer, or for goals on wider ways"
    )


def _doors(traffic: Traffic, walls: DistanceMap, points: Array, goals: Array, rng: np.random.Generator) -> list[Door]:
    """Doors in the narrowest places, those drawn of all that there are."""
    if not traffic.doors:
        return []
    places = doorways(walls, points, goals)
    if len(places) < traffic.doors:
        raise ScenarioError(
            f"the path leads through {len(places)} narrow places for a door, not {traffic.doors}; ask for fewer"
        )
    doors = []
    for at in np.sort(rng.permutation(len(places))[: traffic.doors]):
        middle, heading, width = places[int(at)]
        begun, side = rng.random(2)
        schedule = Schedule(traffic.open_for, traffic.closed_for)
        schedule = replace(schedule, begun=begun * schedule.period)
        doors.append(Door(middle, heading + (math.pi if side < 0.5 else 0.0), width, schedule))
    return doors


def doorways(walls: DistanceMap, points: Array, goals: Array) -> list[tuple[Array, float, float]]:
    """Narrow places of a path (P, 2), the narrowest first: middle (2,) [m], heading across [rad] and width [m]."""
    arc = arc_lengths(points)
    stations = np.arange(FROM_GOAL, max(float(arc[-1]) - FROM_GOAL, FROM_GOAL), STEP)
    found: list[tuple[float, Array, float]] = []
    low, high = DOORWAY
    reach = np.arange(0.0, high + STEP, 0.02)
    for station in stations:
        here, behind, ahead = at_stations(points, arc, np.array([station, station - STEP, station + STEP]))
        along = ahead - behind
        if float(np.hypot(*along)) < STEP or np.hypot(*(goals[:, :2] - here).T).min() < FROM_GOAL:
            continue
        heading = math.atan2(along[0], -along[1])
        across = np.array([math.cos(heading), math.sin(heading)])
        sides = [walls.distance(here + sign * reach[:, None] * across) <= 0.0 for sign in (1.0, -1.0)]
        if not all(side.any() for side in sides):
            continue
        left, right = (float(reach[int(np.argmax(side))]) for side in sides)
        if 2.0 * low <= left + right <= 2.0 * high:
            found.append((left + right, here + 0.5 * (left - right) * across, heading))
    chosen: list[tuple[Array, float, float]] = []
    for width, middle, heading in sorted(found, key=lambda place: place[0]):
        if all(float(np.hypot(*(middle - other))) >= APART for other, _, _ in chosen):
            chosen.append((middle, heading, width))
    return chosen


def moved(things: Sequence[Person | Cart | Door | Fellow]) -> tuple[Array, Array]:
    """(K, 4) discs x, y, radius [m] and 1 of those that are round, (B, 5) x, y, angle, length, width of the others."""
    round_, boxes = [], []
    for thing in things:
        x, y = thing.body.position
        if isinstance(thing, Person | Fellow):
            round_.append((x, y, thing.radius, 1.0))
        else:
            boxes.append((x, y, thing.body.angle, *thing.size))
    return np.array(round_).reshape(-1, 4), np.array(boxes).reshape(-1, 5)
