"""Units and frames: compared where both sides declare them, and without any effect where one does not."""

import logging
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import graph_with
from unifg.models import landmarks, obstacles, quadrotor, space_landmarks, unicycle
from unifg.models.inertial import motion
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array

TURNED = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]  # the identity with its quaternion x first
FLYING = "m, m, m, wxyz, m/s, m/s, m/s"


def plane(frame: str | None = "map", name: str = "x") -> tuple[fg.Graph, fg.Family]:
    graph = fg.Graph()
    return graph, graph.variables(name, fg.SE2, 3, units="m, m, rad", frame=frame)


def flight() -> tuple[fg.Graph, fg.Family, fg.Family]:
    graph, x = graph_with(quadrotor.STATE, 3, units=FLYING, frame="map_T_body")
    return graph, x, graph.variables("u", quadrotor.CONTROL, 2, units="rad/s, rad/s, rad/s, N", frame="body")


def said(add: Callable[[], object]) -> str:
    with pytest.raises(fg.GraphError) as found:
        add()
    return str(found.value)


def test_degrees_are_refused_where_the_data_say_so() -> None:
    graph, x = plane()
    goal = graph.data("goal", [1.0, 2.0, 5.0], units="m, m, deg")
    text = said(lambda: graph.minimize(fg.prior, x[-1], goal, name="end"))
    assert text.startswith("term 'end': argument 1 of prior, data 'goal', declares 'deg' for coordinate 2 of SE2")
    assert "np.radians" in text and graph.terms == []


def test_degrees_are_refused_where_the_numbers_say_so() -> None:
    graph, x = plane()
    text = said(lambda: graph.minimize(fg.prior, x, np.array([[0, 0, 0.1], [1, 0, 45.0], [2, 0, 90.0]]), name="seen"))
    assert "row 1 has 45 for number 2" in text and "np.radians" in text and "fg.wrap_angle" in text
    graph.minimize(fg.prior, x[0], [0.0, 0.0, 7.0])  # more than a turn, as a heading that was counted on may be


def test_degrees_of_an_argument_that_is_no_element() -> None:
    graph, x, _ = flight()
    l = graph.variables("l", fg.Rn(2), 1, units="m, m", frame="map")  # noqa: E741
    seen = graph.data("seen", [40.0, 2.0], units="deg, m")
    assert "'deg' for number 0, the function 'rad'" in said(
        lambda: graph.minimize(landmarks.bearing_range, x[0], l, seen)
    )
    assert "row 0 has 40 for number 0" in said(lambda: graph.minimize(landmarks.bearing_range, x[0], l, [40.0, 2.0]))
    graph.minimize(landmarks.bearing_range, x[0], l, [0.4, 2.0])


def test_one_unit_holds_for_all_numbers_of_a_vector() -> None:
    graph = fg.Graph()
    rate, both = graph.variables("w", fg.Rn(3), 2, units="rad/s"), fg.Product(R=fg.SO3, w=fg.Rn(3))
    gyro = graph.data("gyro", np.ones(3), units="rad/s")
    graph.minimize(fg.prior, rate, gyro)
    graph.minimize(fg.between, rate[0], rate[1], np.ones(3))
    wrong = graph.data("wrong", np.ones(3), units="deg/s")
    assert "argument 1 of prior, data 'wrong', declares 'deg/s' for number 0" in said(
        lambda: graph.minimize(fg.prior, rate, wrong)
    )
    assert "one unit for all, or one for each" in said(lambda: graph.variables("a", fg.Rn(3), 2, units="m, m"))
    assert "6 tangent coordinates: give one for each" in said(lambda: graph.variables("b", both, 2, units="rad"))


def test_angles_of_vectors_may_count_turns(caplog: pytest.LogCaptureFixture) -> None:
    graph, joint = graph_with(fg.Rn(1), 2, "joint", units="rad")
    with caplog.at_level(logging.WARNING, "unifg"):
        graph.minimize(fg.prior, joint, [90.0])
    assert "more than two turns" in caplog.text


@pytest.mark.parametrize("declare", [fg.each, fg.shared])
def test_quaternions_x_first_are_refused(declare: Callable[..., Any]) -> None:
    graph, x = graph_with(fg.SE3, 2, units="m, m, m, wxyz")
    text = said(lambda: graph.minimize(fg.prior, x, declare([TURNED] * 2, units="m, m, m, xyzw"), name="pose"))
    assert "'xyzw'" in text and "from_quaternion(rows, order='xyzw')" in text and "'pose'" in text
    right = fg.SE3.from_quaternion(np.array([TURNED] * 2), order="xyzw")
    graph.minimize(fg.prior, x, declare(right, units="m, m, m, wxyz"))
    assert "w first" in said(lambda: graph.variables("y", fg.SO3, 1, units="xyzw"))


def test_quaternions_that_look_x_first_are_remarked(caplog: pytest.LogCaptureFixture) -> None:
    graph, x = graph_with(fg.SE3, 2, units="m, m, m, rad, rad, rad")
    y = graph.variables("y", fg.SE3, 2)
    with caplog.at_level(logging.WARNING, "unifg"):
        graph.minimize(fg.between, y[:1], y[1:], TURNED)
        assert caplog.text == ""
        graph.minimize(fg.between, x[:1], x[1:], TURNED)
    assert "are its quaternions x first?" in caplog.text


def test_a_wind_in_the_axes_of_the_body_is_refused() -> None:
    graph, x, u = flight()
    rest = [[0.0] * 6], [1.0], [0.0] * 3
    wind = graph.data("wind", [[1.0, 0.0]], units="m/s^2, m/s^2", frame="body")

    def add(wind: Any) -> str:
        return graph.constrain(
            quadrotor.disturbed_dynamics, x[:-1], u, *rest, wind, [[0.0]], x[1:], 0.1, lower=0, upper=0
        )

    text = said(lambda: add(wind))
    assert "data 'wind', is declared in frame 'body', expected 'map' (family 'x')" in text and "transform it" in text
    add(graph.data("steady", [[1.0, 0.0]], units="m/s^2, m/s^2", frame="map"))


def test_a_velocity_in_the_axes_of_the_body_is_refused() -> None:
    graph, x, _ = flight()
    speed = graph.data("speed", [1.0, 0.0, 0.0], units="m/s, m/s, m/s", frame="body")
    assert "'body', expected 'map' (family 'x')" in said(lambda: graph.minimize(fg.prior, x.v, speed))
    assert "'body', expected 'map' (family 'x')" in said(lambda: graph.fix(x[0].v, speed))
    graph.minimize(fg.prior, x.R, graph.data("level", [1.0, 0, 0, 0], units="wxyz", frame="map_T_body"))


def test_a_place_where_a_step_of_the_body_is_expected() -> None:
    graph, x = plane("map_T_base")
    place = graph.data("place", [1.0, 0.0, 0.0], units="m, m, rad", frame="map")
    unnamed, y = plane(name="y")
    there = unnamed.data("there", [1.0, 0.0, 0.0], frame="map")
    assert "expected another than 'map' (family 'y')" in said(lambda: unnamed.minimize(fg.between, y[0], y[1], there))
    step = graph.data("step", [1.0, 0.0, 0.0], units="m, m, rad", frame="base")
    text = said(lambda: graph.minimize(fg.between, x[:-1], x[1:], place))
    assert "data 'place', is declared in frame 'map', expected 'base' (family 'x')" in text
    graph.minimize(fg.between, x[:-1], x[1:], step)


def test_frames_of_other_names_are_refused() -> None:
    graph, x = plane()
    far = graph.variables("far", fg.SE2, 3, frame="odom")
    fix = graph.data("fix", [0.0, 0.0, 0.0], frame="odom")
    for add in (
        lambda: graph.minimize(fg.prior, x[0], fix),
        lambda: graph.minimize(fg.between, x, far, [0.0, 0.0, 0.0]),
        lambda: graph.fix(x[0], fix),
        lambda: graph.constrain(
            obstacles.disc_clearance, x, fg.shared([[1.0, 2.0]], frame="odom"), [0.5], lower=0.0, name="disc"
        ),
    ):
        text = said(add)
        assert "'odom'" in text and "expected 'map' (family 'x')" in text
    limit, p = graph_with(fg.Rn(2), 1, "p", units="m, m", frame="map")
    corner = limit.data("corner", [1.0, 1.0], units="mm, mm")
    assert "'mm'" in said(lambda: limit.bound(p, upper=corner))


def test_sigma_of_a_deviation_is_in_tangent_coordinates() -> None:
    graph, x = plane()
    assert "argument 1 of sigma, a constant, declares 'deg' for number 2, family 'x' 'rad'" in said(
        lambda: graph.minimize(fg.prior, x, np.zeros(3), sigma=fg.shared([0.1, 0.1, 5.0], units="m, m, deg"))
    )
    graph.minimize(fg.prior, x, np.zeros(3), sigma=fg.shared([0.1, 0.1, 100.0], units="m, m, rad"))


def test_limits_of_angles_may_be_none_or_count_turns(caplog: pytest.LogCaptureFixture) -> None:
    graph, wheel = graph_with(fg.Rn(2), 2, "wheel", units="m, rad")
    graph.bound(wheel, lower=-np.inf, upper=[1.0, np.inf])
    assert not caplog.records
    graph.bound(wheel, upper=[1.0, 90.0])
    assert "row 0 has 90 for number 1" in caplog.text


@pytest.mark.parametrize(
    ("manifold", "units"),
    [(fg.SE2, "m, m"), (fg.SE3, "m, m, m, rad"), (fg.Rn(3), "m, m"), (fg.SO2, "m, m"), (quadrotor.STATE, "m, m, m")],
)
def test_as_many_units_as_tangent_coordinates(manifold: fg.Manifold, units: str) -> None:
    graph = fg.Graph()
    text = said(lambda: graph.variables("x", manifold, 1, units=units))
    assert f"{manifold.dim} tangent coordinates" in text and graph.families == {}
    x = graph.variables("x", manifold, 1, frame="map")
    assert "tangent coordinates" in said(
        lambda: graph.minimize(fg.prior, x, fg.shared(manifold.identity(), units=f"{units}, s, s, s"))
    )


def test_malformed_declarations_are_refused() -> None:
    graph = fg.Graph()
    for given in ("m,,rad", "", 3):
        assert "units= is a text" in said(lambda given=given: graph.variables("x", fg.SE2, 1, units=given))  # type: ignore[misc]
    assert "in radians: convert by np.radians" in said(lambda: graph.variables("x", fg.SE2, 1, units="m, m, deg"))
    assert "frame= is a text" in said(lambda: graph.data("z", 1.0, frame=""))


def test_shipped_models_declare_what_they_take() -> None:
    graph, x = plane()
    u = graph.variables("u", fg.Rn(2), 2, units="m/s, deg/s")
    assert "'deg/s' for number 1, the function 'rad/s'" in said(
        lambda: graph.minimize(unicycle.dynamics, x[:-1], u, x[1:], 0.1)
    )
    v, dt = graph.variables("v", fg.Rn(2), 2), fg.shared(100.0, units="ms")
    assert "'ms' for number 0" in said(lambda: graph.minimize(unicycle.dynamics, x[:-1], v, x[1:], dt))
    graph, x, _ = flight()
    assert "'map', expected 'body' (family 'x')" in said(
        lambda: graph.minimize(landmarks.tilt, x.R, fg.shared([0.0, 0.0, 1.0], frame="map"))
    )
    seen = fg.shared([1.0, 0.0, 0.0, 2.0], frame="camera")
    where = fg.shared([1.0, 0.0, 0.0], frame="odom")
    assert "'odom'" in said(lambda: graph.minimize(space_landmarks.bearing_range_3d(quadrotor.STATE), x, where, seen))
    assert len(motion().takes) == 7


def test_functions_of_ones_own_declare_what_they_take() -> None:
    def position(pose: Array, fix: Array) -> Array:
        return pose[:, :2] - fix

    graph, x = plane()
    stated = fg.residual(position, takes=("m, m, rad in W_T_B", "m, m in W"))
    for fix, why in (
        (fg.shared([1.0, 2.0], frame="odom"), "'odom'"),
        (fg.shared([1.0, 2.0], units="km"), "'km' for number 0, the function 'm'"),
        (fg.shared([1.0, 2.0], units="m, m, m"), "declares 3 units (m, m, m), the function 2 (m, m)"),
    ):
        assert why in said(lambda fix=fix: graph.minimize(stated, x, fix))  # type: ignore[misc]
        graph.minimize(position, x, fix)  # which declares nothing
    graph.minimize(stated, x, fg.shared([1.0, 2.0], units="m", frame="map"))
    graph.minimize(fg.residual(position, takes=(None, "in map")), x, fg.shared([1.0, 2.0], frame="map"), name="literal")
    elsewhere, fix = fg.residual(position, takes=(None, "in utm")), fg.shared([1.0, 2.0], frame="map")
    assert "expected 'utm' (the function)" in said(lambda: graph.minimize(elsewhere, x, fix))


def test_declarations_change_no_bit(caplog: pytest.LogCaptureFixture) -> None:
    def solved(**declared: str) -> Array:
        graph, x = graph_with(fg.SE2, 3, **declared)
        graph.minimize(fg.prior, x[0], [0.0, 0.1, 0.2], sigma=0.1)
        graph.minimize(fg.between, x[:-1], x[1:], [1.0, 0.0, 0.3], sigma=[0.1, 0.1, 0.05])
        return np.asarray(LevenbergMarquardt().solve(graph, {x: np.zeros((3, 3))})[x])

    with caplog.at_level(logging.WARNING, "unifg"):
        assert np.array_equal(solved(), solved(units="m, m, rad", frame="map"))
    assert caplog.text == ""


def test_declarations_are_shown_kept_and_pickled() -> None:
    graph, x = plane("map_T_base")
    graph.minimize(fg.prior, x, fg.each(np.zeros((3, 3)), units="m, m, rad"), name="seen")
    goal = graph.data("goal", [1.0, 2.0, 0.0], units="m, m, rad", frame="map")
    graph.minimize(fg.prior, x[-1], goal, name="end")
    for one in (graph, pickle.loads(pickle.dumps(graph)), graph.snapshot()):
        table = str(one)
        assert "m, m, rad  map_T_base" in table and "m, m, rad  map " in table
    graph.replace("seen", sigma=2.0)
    assert graph.term("seen").rows == (None, True)  # type: ignore[union-attr]
    other = fg.residual(lambda p, z: p - z, takes=(None, "mm, mm, rad"), name="other")
    assert "'mm'" in said(lambda: graph.replace("seen", other))
    assert "units" not in str(fg.Graph()) and repr(fg.prior.on(fg.SE2)) == repr(fg.prior.on(fg.SE2))
    loaded = pickle.loads(pickle.dumps(graph))
    with pytest.raises(fg.GraphError, match="'odom'"):
        loaded.minimize(fg.prior, loaded.families["x"][0], fg.shared([0.0, 0.0, 0.0], frame="odom"))
