"""Numbers of settings: what no scenario can mean is refused where it is stated, by the name of its field."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from unifg.errors import ScenarioError, UnifgError
from unifg.models.matching import Gates
from unifg.models.vehicle import Vehicle
from unifg.scenarios.course import CourseSettings
from unifg.scenarios.flight import FlightSettings
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.navigation import NavigationSettings
from unifg.scenarios.options import leaves, plain, replaced
from unifg.scenarios.quadrotor.cbf_mpc import KeeperSettings
from unifg.scenarios.quadrotor.flight_joint import JointSettings
from unifg.scenarios.quadrotor.flight_settings import ControllerSettings as FlightControl
from unifg.scenarios.safe_flight import SafeSettings
from unifg.scenarios.simulation.disturbance import DisturbanceModel
from unifg.scenarios.simulation.plane import LidarModel
from unifg.scenarios.velocity_tracking import TrackingSettings

SIGNED = {
    "updraft",
    "latency",
    "feasible",
    "rolling",
    "drag",
    "drag_constant",
    "drag_linear",
    "gravity",
}  # -1 s: as computed


@pytest.mark.parametrize(
    "settings", [NavigationSettings, FlightSettings, SafeSettings, CourseSettings, TrackingSettings]
)
def test_every_number_is_judged(settings: Any) -> None:
    whole, numbers = settings(), 0
    for leaf in leaves(settings):
        if plain(leaf.kind) in (int, float):
            numbers += 1
            wrong = [-1] if plain(leaf.kind) is int else [math.nan, -1.0][: 1 if leaf.path[-1] in SIGNED else 2]
            for value in wrong:
                if leaf.path[-1] != "seed":
                    with pytest.raises(UnifgError, match=f"{leaf.path[-1]}|must be finite|positive|match"):
                        replaced(whole, leaf.path, value)
    assert numbers > 10


@pytest.mark.parametrize(
    ("settings", "wrong", "message"),
    [
        (KeeperSettings, {"slack": 0.0}, "slack: '0.0' is not a positive number"),
        (KeeperSettings, {"portion": 0}, "portion: '0' is not a whole number of at least 1"),
        (KeeperSettings, {"decide_ms": 0.0}, "decide_ms: '0.0' is not a number above zero"),
        (SafeSettings, {"dt": 1.5}, r"dt: '1.5' is not a tick in \(0, 1\] s"),
        (SafeSettings, {"seen": (1e-3, -1.0, 0.0)}, "seen: '-1.0' is not a number of zero or more"),
        (SafeSettings, {"speed": (1.0, 0.0)}, "speed: '0.0' is not a positive number"),
        (ControllerSettings, {"horizon": 1}, "horizon: '1' is not a whole number of at least 2"),
        (FlightControl, {"horizon": 1}, "horizon: '1' is not a whole number of at least 2"),
        (NavigationSettings, {"initial_sigma": (0.1, -0.1, 0.1)}, "initial_sigma: '-0.1' is not"),
        (NavigationSettings, {"start": (0.0, math.nan, 0.0)}, "start: 'nan' is not a finite number"),
        (DisturbanceModel, {"gust": (0.1, 0.1)}, r"gust: 3 numbers are expected, found \(0.1, 0.1\)"),
        (DisturbanceModel, {"gust": [0.1, 0.1, -0.1]}, "gust: '-0.1' is not a number of zero or more"),
        (DisturbanceModel, {"gust": np.array([0.1, 0.1, np.nan])}, "gust: 'nan' is not"),
        (DisturbanceModel, {"gust_time": np.float32(0.0)}, "gust_time: '0.0' is not a positive number"),
        (Gates, {"match": 60.0}, "0 < match <= new"),
        (Vehicle, {"equivalent_mass": 0.0}, "mass must be a finite number above 0"),
    ],
)
def test_numbers_in_rows_and_of_parts_are_judged(settings: Any, wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(UnifgError, match=message):
        settings(**wrong)


@pytest.mark.parametrize(
    ("settings", "wrong", "message"),
    [
        (ControllerSettings, {"dt": 0.0}, "dt"),
        (ControllerSettings, {"horizon": 0}, "horizon"),
        (ControllerSettings, {"sigmas": -1.0}, "sigmas"),
        (ControllerSettings, {"wall_clearance": -0.1}, "wall_clearance"),
        (ControllerSettings, {"avoidance": "hope"}, "unknown avoidance 'hope': .* potential, vortex"),
        (ControllerSettings, {"futures": "best"}, "unknown futures 'best'"),
        (ControllerSettings, {"futures": "tree", "tails": 1}, "two tails or more"),
        (ControllerSettings, {"futures": "tree", "shared": 30}, "shares 1 to 29 of 30 steps"),
        (LidarModel, {"beams": 0}, "beams: '0' is not a whole number of at least 2"),
        (LidarModel, {"beams": 1}, "beams: '1' is not a whole number of at least 2"),
        (LidarModel, {"range_max": 0.0}, "range_max: '0.0' is not a positive number"),
        (JointSettings, {"pull": 0.0}, "sequential"),
        (JointSettings, {"pull": -1.0}, "sequential"),
        (JointSettings, {"pull": math.nan}, "sequential"),
    ],
)
def test_settings_that_mean_nothing_are_refused(settings: Any, wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        settings(**wrong)


@pytest.mark.parametrize(
    ("settings", "weights"),
    [(CourseSettings, "goal end rest level rate thrust near"), (TrackingSettings, "track end effort")],
)
def test_weights_of_costs_are_positive(settings: Any, weights: str) -> None:
    for name in weights.split():
        with pytest.raises(UnifgError, match=f"^{name}: '0.0' is not a positive number"):
            settings(**{name: 0.0})


def test_what_a_number_may_be_is_kept() -> None:
    assert NavigationSettings(start=(-1.0, -2.0, -3.0)).start == (-1.0, -2.0, -3.0)
    assert KeeperSettings(decide_ms=math.inf, slack=None).slack is None
    assert replaced(FlightSettings(), ("controller", "height_limits"), (-1.0, 2.0)).controller.height_limits[0] == -1.0
