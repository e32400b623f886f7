"""People who go about in a building besides the robot.

They walk to and fro along a way, at a pace of their own, by social forces (Helbing, Farkas, Vicsek, Nature 407 (2000),
eqs. 1 to 3 without those of touching bodies): they want to go on at their pace, and keep off walls and each other. They
do not wait for the robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np

from unifg.errors import ScenarioError
from unifg.models.distance_map import DistanceMap
from unifg.scenarios.options import Settings, count, option, positive
from unifg.scenarios.planning.polyline import arc_lengths, at_stations
from unifg.scenarios.simulation.space import Mover, Space, reflected
from unifg.typing import Array

__all__ = ["Social", "Traffic", "draw_traffic"]

RELAXATION = 0.5  # [s], of a person's velocity to the one that is wanted
PUSH, REACH = 25.0, 0.08  # of a person: acceleration at a touch [m/s^2], length over which it falls to 1/e [m]
HASTE = 1.3  # fastest walk, in shares of the pace that is wanted
MOST = 200  # people
CARROT = 0.5  # [m] ahead on their way that people go for
FROM_START = 3.0  # [m] from the start, without people at the beginning
PERSON = (0.18, 0.25)  # radius [m]
WALK = (3.0, 10.0)  # shortest and longest way of a person [m]
STEP = 0.1  # [m] between places that are tried
DRAWS = 200  # of each


@dataclass(frozen=True)
class Traffic(Settings):
    """People in the building; none by default.

    Attributes:
        people: number of people who walk along the planned path.
        slowest: least pace of a person; each draws one between this and ``fastest`` [m/s].
        fastest: [m/s].
    """

    people: int = option(0, text=partial(count, most=MOST), metavar="K")
    slowest: float = option(0.3, text=positive, metavar="M/S", flag="people-slowest")
    fastest: float = option(1.5, text=positive, metavar="M/S", flag="people-fastest")

    def __post_init__(self) -> None:
        """Refuse numbers and paces out of bounds.

        Raises:
            ScenarioError: naming the field.
        """
        super().__post_init__()
        if self.slowest > self.fastest:
            raise ScenarioError(f"people walk at slowest <= fastest, got {self.slowest:g} and {self.fastest:g} m/s")


class Social:
    """Policy of a person: walk to and fro along a way by social forces.

    Attributes:
        others: movers that it keeps off.
    """

    def __init__(self, way: Array, radius: float, pace: float, walls: DistanceMap) -> None:
        """Begin at the beginning of a way.

        Args:
            way: (P, 2) [m].
            radius: [m].
            pace: at which the person wants to walk [m/s].
            walls: distance to them.
        """
        self.way, self.radius, self.pace = way, radius, pace
        self.others: list[Mover] = []
        self._walls, self._arc = walls, arc_lengths(way)
        self._along, self._sense = 0.0, 1.0

    def velocity(self, mover: Mover, space: Space, dt: float) -> tuple[float, float]:
        """Velocity after ``dt`` [s] of the forces, at most a hasty walk."""
        velocity = np.array(mover.body.velocity)
        velocity = velocity + dt * self.force(np.array(mover.body.position), velocity)
        velocity *= min(1.0, HASTE * self.pace / max(float(np.hypot(*velocity)), 1e-12))
        return float(velocity[0]), float(velocity[1])

    def force(self, place: Array, velocity: Array) -> Array:
        """(2,) acceleration at a place (2,) and velocity (2,), between what is wanted and what is kept off [m/s^2]."""
        carrot = at_stations(self.way, self._arc, np.array([self._along]))[0] - place
        # Once to and fro: of a way that bends or is short, no point may be far enough.
        for _ in range(math.ceil(2.0 * float(self._arc[-1]) / STEP)):
            if float(np.hypot(*carrot)) >= CARROT:
                break
            self._along, self._sense = reflected(self._along, self._sense, STEP, float(self._arc[-1]))
            carrot = at_stations(self.way, self._arc, np.array([self._along]))[0] - place
        made: Array = (self.pace * carrot / max(float(np.hypot(*carrot)), 1e-6) - velocity) / RELAXATION
        for other in self.others:
            away = place - np.array(other.body.position)
            distance = max(float(np.hypot(*away)), 1e-6)
            made += PUSH * math.exp((self.radius + other.radius - distance) / REACH) * away / distance
        off_walls, slope = self._walls.distance_and_gradient(place)
        made += PUSH * math.exp(min((self.radius - float(off_walls)) / REACH, 1.0)) * slope
        return made


def draw_traffic(traffic: Traffic, walls: DistanceMap, path: Array, rng: np.random.Generator) -> list[Mover]:
    """Draw the people on or beside a planned path.

    Args:
        traffic: number and paces.
        walls: distance to them.
        path: (P, 3) planned path, from the start over all goals.
        rng: source of all numbers.

    Raises:
        ScenarioError: there is no place for so many.
    """
    (of_people,) = rng.spawn(1)
    people = [_person(traffic, walls, path[:, :2], of_people) for _ in range(traffic.people)]
    movers = [Mover(person.way[0], person.radius, person) for person in people]
    for person, own in zip(people, movers, strict=True):
        person.others = [other for other in movers if other is not own]
    return movers


def _stretch(points: Array, rng: np.random.Generator) -> Array:
    """(Q, 2) a piece of a path that begins far from the robot, in one of both senses [m]."""
    arc = arc_lengths(points)
    where, length, back = rng.random(3)
    begin = FROM_START + where * max(float(arc[-1]) - FROM_START, 0.0)
    span = (WALK[0] + length * (WALK[1] - WALK[0])) * (1.0 if back < 0.5 else -1.0)
    end = float(np.clip(begin + span, 0.0, arc[-1]))
    stations = np.linspace(begin, end, max(2, round(abs(end - begin) / STEP) + 1))
    return at_stations(points, arc, stations)


def _person(traffic: Traffic, walls: DistanceMap, points: Array, rng: np.random.Generator) -> Social:
    for _ in range(DRAWS):
        way, (size, pace, aside) = _stretch(points, rng), rng.random(3)
        radius = PERSON[0] + size * (PERSON[1] - PERSON[0])
        along = np.gradient(way, axis=0)
        normal = np.column_stack([-along[:, 1], along[:, 0]]) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
        way = way + (aside - 0.5) * normal
        far = np.hypot(*(way[0] - points[0])) >= FROM_START
        if far and arc_lengths(way)[-1] > CARROT and walls.distance(way).min() >= radius + 0.02:
            speed = traffic.slowest + pace * (traffic.fastest - traffic.slowest)
            return Social(way, radius, float(speed), walls)
    raise ScenarioError("there is no place for so many people along the path; ask for fewer, or for goals farther away")
