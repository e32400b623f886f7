"""Control problems stated twice, as a graph and in casadi, by kind; a seed draws the numbers of each."""

from __future__ import annotations

from collections.abc import Callable

from problems.twins import flights, ground, machines
from problems.twins.twin import Twin

KINDS: dict[str, Callable[..., Twin]] = {
    "free final time": flights.free_time,
    "two robots": ground.two_robots,
    "relay": ground.relay,
    "thrust cone": flights.landing,
    "attitude slew": flights.slew,
    "minimum snap": flights.minimum_snap,
    "pendulum": ground.pendulum,
    "cart-pole": ground.cart_pole,
    "gates": flights.gates,
    "two-link arm": machines.arm,
    "hover with drag": flights.hover,
    "lane change": ground.lane_change,
    "payload": machines.payload,
    "orbit": flights.orbit,
    "parking": ground.parking,
}
