"""IMU preintegration: exact increments, their covariance and biases, the factor, and the bookkeeping of a window."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from numpy.random import Generator
from scipy.integrate import solve_ivp
from scipy.linalg import expm

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.codegen.compile_counter import counting
from unifg.errors import ModelError
from unifg.lie import SE23, SO3
from unifg.models import inertial, preintegration
from unifg.models.inertial import InertialMeasurements, SampleCounts
from unifg.models.preintegration import BIAS, ImuNoise, Preintegrated, at_rest, predict, preintegrate
from unifg.models.quadrotor import STATE
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array

NOISE = ImuNoise(gyro=1e-3, accelerometer=1e-2, gyro_walk=1e-4, accelerometer_walk=1e-3)
NONE = np.zeros(6)


def sample(w: Array, a: Array, h: float) -> tuple[Array, Array]:
    Y, by = np.full(10, np.nan), np.full((9, 6), np.nan)
    preintegration.sample(np.asarray(w, dtype=float), np.asarray(a, dtype=float), h, Y, by)
    return Y, by


def log_of(count: int, rng: Generator, rate: float = 200.0, turn: float = 1.0) -> tuple[Array, Array, Array]:
    """Stamps, rates and forces that wander smoothly."""
    t = np.arange(count) / rate
    phase, speed = rng.uniform(0.0, 6.0, (2, 3)), rng.uniform(0.5, 3.0, (2, 3))
    w, a = (np.sin(t[:, None] * speed[k] + phase[k]) for k in range(2))
    return t, turn * w, 3.0 * a + [0.0, 0.0, 9.81]


MOVED = preintegrate([0.0], np.zeros((1, 3)), np.zeros((1, 3)), [0.0, 0.01], NOISE, NONE)


# ---------------------------------------------------------------- one sample


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-9, 1e-4, 0.3, 0.999, 1.001, 2.0, np.pi - 1e-7, np.pi, 5.0, 9.0])
def test_a_held_sample_is_exact(angle: float, rng: Generator) -> None:
    """Gamma_1 and Gamma_2 are blocks of an exponential; derivatives are those of differences."""
    w, a = rng.standard_normal((2, 3))
    h = 0.7
    w *= angle / h / np.linalg.norm(w)
    hat = np.zeros((5, 5))
    hat[:3, :3], hat[:3, 3], hat[3, 4] = SO3.hat(w), a, 1.0
    exact = expm(h * hat)
    Y, by = sample(w, a, h)
    np.testing.assert_allclose(Y[3:6], exact[:3, 3], atol=3e-15)
    np.testing.assert_allclose(Y[:3], exact[:3, 4], atol=3e-15)
    np.testing.assert_allclose(SO3.matrix(Y[6:]), exact[:3, :3], atol=3e-15)
    if angle > np.pi - 1e-3:
        assert SE23.is_valid(Y)
    step = 1e-5
    for k in range(6):
        d = step * np.eye(6)[k]
        ahead, behind = (sample(w + s * d[:3], a + s * d[3:], h)[0] for s in (1.0, -1.0))
        slope = (SE23.local(Y, ahead) - SE23.local(Y, behind)) / (2.0 * step)
        np.testing.assert_allclose(by[:, k], slope, atol=2e-10)


def test_the_series_meets_the_closed_form() -> None:
    below, above = (preintegration.gamma(t) for t in (np.nextafter(1.0, 0.0), 1.0))
    np.testing.assert_allclose(below, above, rtol=2e-13)
    np.testing.assert_allclose(preintegration.gamma(0.0), [1.0 / 24.0, -1.0 / 360.0], rtol=1e-15)


# ---------------------------------------------------------------- intervals


def integrated_finely(t: Array, w: Array, a: Array, start: float, end: float, bias: Array) -> Array:
    """Position, velocity and rotation matrix of Y, by an integrator that knows nothing of groups."""
    whole, now = np.concatenate([np.zeros(6), np.eye(3).ravel()]), start
    while now < end - 1e-15:
        k = int(np.searchsorted(t, now + 1e-12, side="right")) - 1
        until = min(end, t[k + 1] if k + 1 < len(t) else end)
        hat, force = SO3.hat(w[k] - bias[:3]), a[k] - bias[3:]

        def rates(_: float, x: Array, hat: Array = hat, force: Array = force) -> Array:
            R = x[6:].reshape(3, 3)
            return np.concatenate([x[3:6], R @ force, (R @ hat).ravel()])

        whole = solve_ivp(rates, (now, until), whole, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
        now = until
    return whole


def test_dense_integration_of_the_same_samples(rng: Generator) -> None:
    """Nodes that fall between samples, on them, several in one sample, and biases that are not zero."""
    t, w, a = log_of(60, rng, turn=4.0)
    times = np.array([0.0, 0.0031, 0.004, 0.0201, 0.1, 0.29])
    bias = np.array([0.01, -0.02, 0.03, 0.2, -0.1, 0.3])
    found = preintegrate(t, w, a, times, NOISE, bias)
    for k in range(len(times) - 1):
        exact = integrated_finely(t, w, a, times[k], times[k + 1], bias)
        mine = np.concatenate([found.increment[k, :6], SO3.matrix(found.increment[k, 6:]).ravel()])
        np.testing.assert_allclose(mine, exact, atol=1e-11)
    np.testing.assert_allclose(found.duration, np.diff(times))
    np.testing.assert_allclose(found.held, [0.0031, 0.004, 0.005, 0.005, 0.005], atol=1e-15)  # since their stamps


def test_intervals_compose(rng: Generator) -> None:
    """Two intervals one after the other are the interval of both: increment, covariance and derivatives by biases."""
    t, w, a = log_of(100, rng, turn=6.0)
    one = preintegrate(t, w, a, [0.0, 0.2, 0.45], NOISE, NONE)
    whole = preintegrate(t, w, a, [0.0, 0.45], NOISE, NONE)
    h = one.duration[1]
    drifted = one.increment[0].copy()
    drifted[:3] += h * drifted[3:6]
    np.testing.assert_allclose(SE23.local(whole.increment[0], SE23.compose(drifted, one.increment[1])), 0.0, atol=1e-13)
    F = np.eye(9)
    F[:3, 3:6] = h * np.eye(3)
    A = SE23.adjoint(SE23.inverse(one.increment[1])) @ F
    both = A @ one.covariance[0] @ A.T + one.covariance[1]
    np.testing.assert_allclose(whole.covariance[0], both, atol=1e-12 * np.abs(both).max())
    np.testing.assert_allclose(whole.by_bias[0], A @ one.by_bias[0] + one.by_bias[1], atol=1e-12)


def test_derivatives_by_biases_and_the_order_of_the_correction(rng: Generator) -> None:
    t, w, a = log_of(100, rng, turn=6.0)
    at = np.array([0.01, 0.0, -0.02, 0.1, 0.2, -0.1])
    found = preintegrate(t, w, a, [0.0, 0.5], NOISE, at)
    direction, errors = rng.standard_normal(6), []
    for size in (1e-5, 1e-2, 0.5e-2):
        moved = preintegrate(t, w, a, [0.0, 0.5], NOISE, at + size * direction).increment[0]
        corrected = SE23.retract(found.increment[0], size * found.by_bias[0] @ direction)
        errors.append(np.abs(SE23.local(corrected, moved)).max())
    assert errors[0] < 1e-9  # of 1e-5: second order
    assert 3.8 < errors[1] / errors[2] < 4.2


def test_covariance_against_monte_carlo(rng: Generator) -> None:
    """Noise that is white in continuous time, drawn five times in each sample; strong turns, one second."""
    count, runs, finer, h = 20, 4000, 5, 0.05
    t = h * np.arange(count)
    w, a = 3.0 * rng.standard_normal((count, 3)), 5.0 * rng.standard_normal((count, 3))
    noise = ImuNoise(gyro=0.02, accelerometer=0.1)
    found = preintegrate(t, w, a, [0.0, count * h], noise, NONE)
    Y = np.tile(SE23.identity(), (runs, 1))
    cut = h / finer
    for k in range(count * finer):
        spread = np.repeat([noise.gyro, noise.accelerometer], 3) / np.sqrt(cut)
        n = spread * rng.standard_normal((runs, 6))
        rate, force = w[k // finer] + n[:, :3], a[k // finer] + n[:, 3:]
        pushed = SE23.exp(np.concatenate([np.zeros((runs, 3)), cut * force, cut * rate], axis=1))
        pushed[:, :3] = 0.5 * cut * pushed[:, 3:6]  # Gamma_2 to second order
        Y[:, :3] += cut * Y[:, 3:6]
        Y = SE23.compose(Y, pushed)
    errors = SE23.local(found.increment[0], Y)
    sampled = errors.T @ errors / runs
    scale = np.sqrt(np.diag(found.covariance[0]))
    both = (sampled - found.covariance[0]) / np.outer(scale, scale)
    assert np.abs(both).max() < 5.0 / np.sqrt(runs)  # of correlations, entry by entry
    nees = np.einsum("ni,ij,nj->n", errors, found.information[0], errors).mean()
    assert abs(nees - 9.0) < 5.0 * np.sqrt(18.0 / runs)


def test_one_sample_has_an_information() -> None:
    """Held noise has six directions for nine rows; white noise inside the sample gives the rest."""
    found = preintegrate([0.0], [[0.1, 0.2, 0.3]], [[0.0, 0.0, 9.8]], [0.0, 0.005], NOISE, NONE)
    assert np.linalg.matrix_rank(found.covariance[0] / np.outer(*[np.sqrt(np.diag(found.covariance[0]))] * 2)) == 9
    np.testing.assert_allclose(found.information[0] @ found.covariance[0], np.eye(9), atol=1e-8)
    assert np.array_equal(found.information[0], found.information[0].T)


def test_what_is_not_covered_has_no_information(rng: Generator) -> None:
    t, w, a = log_of(20, rng)
    found = preintegrate(t + 1.0, w, a, [0.9, 1.0, 1.05, 1.2], NOISE, NONE)
    assert found.held[0] == np.inf and np.array_equal(found.increment[0], SE23.identity())
    assert not found.information[0].any() and found.information[1:].any(axis=(1, 2)).all()
    assert abs(found.held[2] - 0.105) < 1e-12  # the last sample is held to the end
    rounded = preintegrate(t + 1.0, w, a, [np.nextafter(1.0, 0.0), 1.05], NOISE, NONE)  # a node counted back from now
    assert rounded.held[0] < 0.006 and rounded.information[0].any()
    empty = preintegrate(np.empty(0), np.empty((0, 3)), np.empty((0, 3)), [0.0, 1.0], NOISE, NONE)
    assert empty.held[0] == np.inf


@pytest.mark.parametrize(
    ("kind", "changed", "words"),
    [
        (ModelError, lambda t, w: {"gyro": w[:4]}, r"\(k, 3\) rates"),
        (ModelError, lambda t, w: {"gyro": np.where(w == w[2, 1], np.nan, w)}, "must be finite"),
        (ModelError, lambda t, w: {"stamps": t[::-1]}, "stamps must be finite and increase"),
        (ModelError, lambda t, w: {"times": [0.0, 0.0]}, "times must be finite and increase"),
        (ModelError, lambda t, w: {"times": [0.0, np.inf]}, "times must be finite"),
        (ModelError, lambda t, w: {"times": [0.0]}, "two or more node times"),
        (ModelError, lambda t, w: {"bias": np.full(6, np.nan)}, "must be finite"),
        (ModelError, lambda t, w: {"bias": np.zeros(3)}, r"a bias is \(6,\).*found \(3,\)"),
        (fg.GraphError, lambda t, w: {"gyro": np.ma.masked_array(w, w > 0.0)}, "rates is a masked"),
        (fg.GraphError, lambda t, w: {"gyro": w + 0j}, "found complex numbers"),
        # The class has attributes of these names, too: its defaults.
        (ModelError, lambda t, w: {"noise": ImuNoise}, "noise must be of the class ImuNoise"),
        (ModelError, lambda t, w: {"noise": None}, "noise must be of the class ImuNoise"),
    ],
)
def test_bad_logs_are_refused(kind: type[Exception], changed: Any, words: str, rng: Generator) -> None:
    t, w, a = log_of(5, rng)
    log = {"stamps": t, "gyro": w, "accelerometer": a, "times": [0.0, 1.0], "noise": NOISE, "bias": NONE}
    with pytest.raises(kind, match=words):
        preintegrate(**log | changed(t, w))


@pytest.mark.parametrize("density", [0.0, -1e-3, np.nan, np.inf, 1e-200, 1e200])
@pytest.mark.parametrize("name", ["gyro", "accelerometer", "gyro_walk", "accelerometer_walk"])
def test_densities_that_are_none_are_refused_by_name(name: str, density: float) -> None:
    """A zero on the diagonal took the information of all nine rows away, and nothing was said."""
    if name.endswith("walk") and 0.0 <= density < 1.0:
        assert not ImuNoise(**{name: density}).walk([1.0]).min() > density
        return
    with pytest.raises(ModelError, match=re.escape(f"{name} {density!r} must be a density from")):
        ImuNoise(**{name: density})


@pytest.mark.parametrize("gyro", [1e-9, 1e-6, 1e-3, 1.0, 1e3])
@pytest.mark.parametrize("accelerometer", [1e-9, 1e-6, 1e-2, 1e3])
def test_an_information_is_positive_however_far_apart_densities_are(
    gyro: float, accelerometer: float, rng: Generator
) -> None:
    t, w, a = log_of(40, rng)
    found = preintegrate(t, w, a, [0.0, 0.1, 0.2], ImuNoise(gyro, accelerometer), NONE)
    scale = np.sqrt(np.einsum("nii->ni", found.covariance))
    both = found.information * scale[:, :, None] * scale[:, None, :]
    assert np.linalg.eigvalsh(both).min() > 0.0


def test_a_covariance_without_an_inverse_is_refused(rng: Generator) -> None:
    t, w, a = log_of(40, rng)
    found = preintegrate(t, w, a, [-1.0, 0.0, 0.1, 0.2], NOISE, NONE)
    covariance = found.covariance.copy()
    covariance[2] = 1.0
    with pytest.raises(ModelError, match="lie too far apart"):
        assert found._replace(covariance=covariance).information is None


@pytest.mark.parametrize("noise", [ImuNoise(gyro_walk=0.0), ImuNoise(accelerometer_walk=0.0)])
def test_biases_without_a_walk_are_one(noise: Any) -> None:
    graph, x = graph_with(SE23, 3)
    graph.variables("bias", BIAS, 3)
    with pytest.raises(ModelError, match="which must be positive; one bias that stays"):
        InertialMeasurements(noise).state(graph, x)
    graph.variables("one", BIAS, 1)
    InertialMeasurements(noise, bias="one").state(graph, x)


# ---------------------------------------------------------------- the factor


def factor(states: Array, measured: Preintegrated, bias: Array = NONE, manifold: fg.Manifold = SE23) -> Array:
    biases = np.broadcast_to(bias, (len(states) - 1, 6))
    return inertial.motion(manifold)(states[:-1], states[1:], biases, *measured[:4])


def in_parts(x: Array) -> Array:
    """The same states as a quadrotor's: p, R, v."""
    return STATE.pack(p=x[:, :3], v=x[:, 3:6], R=x[:, 6:])


@pytest.mark.parametrize("far", [0.0, 1e6])
def test_the_residual_of_the_motion_itself_is_zero(far: float, rng: Generator) -> None:
    """Anywhere on a map, any attitude, intervals that turn by pi and by more."""
    t, w, a = log_of(200, rng, turn=0.0)
    w = np.tile(np.pi / 0.25 * np.array([0.6, 0.0, 0.8]), (200, 1))  # half a turn in each of four intervals
    measured = preintegrate(t, w, a, [0.0, 0.25, 0.5, 0.75, 1.0], NOISE, NONE)
    start = SE23.random(rng)
    start[:3] += far
    states = predict(start, measured)
    tight = 1e-9 if far else 1e-13
    assert np.abs(factor(states, measured)).max() < tight
    np.testing.assert_allclose(factor(in_parts(states), measured, manifold=STATE), factor(states, measured), atol=1e-15)
    off = SE23.retract(states, 0.1 * rng.standard_normal((5, 9)))
    np.testing.assert_allclose(
        factor(in_parts(off), measured, manifold=STATE), factor(off, measured), atol=1e-9 if far else 1e-13
    )


def test_an_error_of_the_end_is_the_residual(rng: Generator) -> None:
    """Y Exp(xi): the covariance of the increment is that of the residual, however large xi."""
    t, w, a = log_of(100, rng)
    measured = preintegrate(t, w, a, [0.0, 0.5], NOISE, NONE)
    xi = rng.standard_normal(9)
    states = predict(SE23.random(rng), measured)
    states[1] = SE23.retract(states[1], xi)
    np.testing.assert_allclose(factor(states, measured)[0], xi, atol=1e-13)


def test_free_fall_and_rest() -> None:
    """Units and signs: no force is free fall, a force of -g in the body's axes is rest."""
    q = SO3.from_rpy(0.3, -0.2, 1.0)
    resting = preintegrate([0.0], [np.zeros(3)], [at_rest(q)], [0.0, 2.0], NOISE, NONE)
    start = SE23.from_parts([1.0, 2.0, 3.0], np.zeros(3), q)
    np.testing.assert_allclose(predict(start, resting)[1], start, atol=1e-14)
    falling = preintegrate([0.0], [np.zeros(3)], [np.zeros(3)], [0.0, 2.0], NOISE, NONE)
    end = predict(start, falling)[1]
    np.testing.assert_allclose(end[:6], [1.0, 2.0, 3.0 - 0.5 * 9.81 * 4.0, 0.0, 0.0, -9.81 * 2.0], atol=1e-13)
    turned = inertial.motion(gravity=(0.0, 0.0, -3.71))  # on Mars
    assert abs(turned(start[None], end[None], NONE[None], *falling[:4])[0]).max() > 1.0


def test_a_mean_force_is_felt_between_two_nodes() -> None:
    """Nothing is left of rest and of free fall, nor of a held force but for a twelfth of the square of the turn."""
    felt, q, h = inertial.specific_force(), SO3.from_rpy(0.3, -0.2, 1.0), 0.1
    start = SE23.from_parts([1.0, 2.0, 3.0], [1.0, 0.0, 0.5], q)
    np.testing.assert_allclose(felt(start[None], start[None], at_rest(q)[None], 1.0 / h), 0.0, atol=1e-14)
    turn, force = np.array([0.4, -1.0, 2.0]), np.array([1.0, -2.0, 12.0])
    for rates, pushed in ((np.zeros(3), np.zeros(3)), (np.zeros(3), force), (turn, force)):
        end = predict(start, preintegrate([0.0], [rates], [pushed], [0.0, h], NOISE, NONE))[1]
        left = felt(start[None], end[None], pushed[None], 1.0 / h)[0]
        angle = h * float(np.linalg.norm(rates))
        np.testing.assert_allclose(left, 0.0, atol=1e-12 + 1.05 * angle**2 / 12.0 * float(np.linalg.norm(pushed)))
    assert abs(inertial.specific_force(gravity=(0.0, 0.0, -3.71))(start[None], end[None], force[None], 10.0)).max() > 5


@pytest.mark.parametrize("made", [inertial.motion, inertial.specific_force])
@pytest.mark.parametrize(
    "manifold", [fg.SE3, fg.Product(p=fg.Rn(3), v=fg.Rn(3)), fg.Product(p=fg.Rn(2), v=fg.Rn(3), R=SO3)], ids=str
)
def test_states_that_have_not_all_parts_are_refused(made: Any, manifold: fg.Manifold) -> None:
    with pytest.raises(ModelError, match="needs a position, a velocity and an orientation"):
        made(manifold)


@pytest.mark.parametrize("gravity", [-9.81, (0.0, -9.81), (0.0, 0.0), (0.0, 0.0, np.nan)], ids=str)
@pytest.mark.parametrize(
    "made",
    [
        lambda gravity: inertial.motion(gravity=gravity),
        lambda gravity: inertial.specific_force(gravity=gravity),
        lambda gravity: predict(SE23.identity(), MOVED, gravity),
        lambda gravity: at_rest(SO3.identity(), gravity),
    ],
)
def test_a_gravity_is_three_numbers(made: Any, gravity: Any) -> None:
    """A number for all axes is no gravity."""
    with pytest.raises(ModelError, match="three finite numbers"):
        made(gravity)


def test_a_prediction_begins_at_a_state() -> None:
    with pytest.raises(ModelError, match=r"SE23, \(10,\), found \(7,\)"):
        predict(np.zeros(7), MOVED)


# ---------------------------------------------------------------- GTSAM


def test_gtsam_agrees(rng: Generator) -> None:
    """Increment, covariance, derivatives by biases and residual; its own are of first order in the sampling time."""
    gtsam = pytest.importorskip("gtsam")
    rate, seconds = 10_000.0, 0.3
    t, w, a = log_of(int(rate * seconds), rng, rate=rate, turn=2.0)
    bias = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.05])
    mine = preintegrate(t, w, a, [0.0, seconds], NOISE, bias)
    setting = gtsam.PreintegrationParams.MakeSharedU(9.81)
    setting.setGyroscopeCovariance(NOISE.gyro**2 * np.eye(3))
    setting.setAccelerometerCovariance(NOISE.accelerometer**2 * np.eye(3))
    setting.setIntegrationCovariance(np.zeros((3, 3)))
    believed = gtsam.imuBias.ConstantBias(bias[3:], bias[:3])
    theirs = gtsam.PreintegratedImuMeasurements(setting, believed)
    for k in range(len(t)):
        theirs.integrateMeasurement(a[k], w[k], 1.0 / rate)
    np.testing.assert_allclose(mine.increment[0, :3], theirs.deltaPij(), atol=2e-4)
    np.testing.assert_allclose(mine.increment[0, 3:6], theirs.deltaVij(), atol=2e-3)
    np.testing.assert_allclose(SO3.matrix(mine.increment[0, 6:]), theirs.deltaRij().matrix(), atol=1e-5)

    # Its rows are rotation, position, velocity: the rotation vector itself, the others in the axes of the first body.
    order, turn = np.r_[6:9, 0:3, 3:6], np.eye(9)
    turn[:3, :3] = turn[3:6, 3:6] = SO3.matrix(mine.increment[0, 6:])
    turn[6:, 6:] = SO3.right_jacobian_inverse(SO3.log(mine.increment[0, 6:]))
    covariance = (turn @ mine.covariance[0] @ turn.T)[np.ix_(order, order)]
    scale = np.outer(*[np.sqrt(np.diag(covariance))] * 2)
    np.testing.assert_allclose(theirs.preintMeasCov() / scale, covariance / scale, atol=0.002)

    # The residual of a state that is off, at another bias: theirs in the axes of the second body, with the other sign.
    x = SE23.from_parts([1.0, 2.0, 3.0], [0.5, -0.5, 0.2], SO3.from_rpy(0.1, -0.2, 0.3))
    exact = predict(x, mine)[1]
    y = SE23.retract(exact, 1e-3 * rng.standard_normal(9))
    other = bias + 1e-3 * rng.standard_normal(6)
    imu = gtsam.ImuFactor(0, 1, 2, 3, 4, theirs)

    def error(y: Array, bias: Array) -> Array:
        first, second = (gtsam.Pose3(gtsam.Rot3(SO3.matrix(s[6:])), s[:3]) for s in (x, y))
        shift = gtsam.imuBias.ConstantBias(bias[3:], bias[:3])
        return np.asarray(imu.evaluateError(first, x[3:6], second, y[3:6], shift))

    r = factor(np.array([x, y]), mine, other)[0]
    first_order = error(exact, bias)  # of its integration
    np.testing.assert_allclose(first_order - error(y, other), r[order], atol=1e-5)
    assert np.abs(r).max() > 1e-3


# ---------------------------------------------------------------- estimation, and the window


def flight(seconds: float, rng: Generator, bias: Array, rate: float = 200.0) -> tuple[Array, Array, Array, Array]:
    """Samples with noise and biases, and the true states at their stamps."""
    count = int(seconds * rate)
    t, w, a = log_of(count, rng, rate=rate)
    a[:, :2] *= 0.5
    clean = preintegrate(t, w, a, np.append(t, t[-1] + 1.0 / rate), NOISE, NONE)
    truth = predict(SE23.from_parts(np.zeros(3), [1.0, 0.0, 0.0], SO3.from_rpy(0.1, 0.2, -0.3)), clean)
    spread = np.sqrt(rate) * np.repeat([NOISE.gyro, NOISE.accelerometer], 3)
    shown = np.concatenate([w, a], axis=1) + bias + spread * rng.standard_normal((count, 6))
    return t, shown[:, :3], shown[:, 3:], truth


def estimator(
    nodes: int, manifold: fg.Manifold = SE23
) -> tuple[fg.Graph, fg.Family, fg.Family, InertialMeasurements, fg.Data]:
    graph, x, bias = graph_of(("x", manifold, nodes), ("bias", BIAS, nodes))
    imu = InertialMeasurements(NOISE)
    imu.state(graph, x)
    fixes = graph.data("places", np.zeros((nodes, 3)), each=True)
    graph.minimize(lambda x, z: x[:, :3] - z, x, fixes, sigma=0.02, name="places")
    graph.minimize(fg.prior, bias[0], np.zeros(6), sigma=[0.1] * 3 + [0.5] * 3, name="bias")
    return graph, x, bias, imu, fixes


@pytest.mark.parametrize("manifold", [SE23, STATE], ids=lambda m: m.name)
def test_states_and_biases_are_estimated_consistently(manifold: fg.Manifold, rng: Generator) -> None:
    """Eight seconds, fixes at every node; errors within their covariances over five flights."""
    spans = 0.2 * np.arange(41)
    scores = []
    graph, x, bias, imu, fixes = estimator(41, manifold)
    run = LevenbergMarquardt().prepare(graph)
    for k in range(5):
        true_bias = np.array([0.02, -0.03, 0.01, 0.2, -0.1, 0.15]) * rng.standard_normal(6)
        t, w, a, states = flight(8.2, rng, true_bias)
        imu.add(t + 100.0 * k, w, a)
        times, at = spans + 100.0 * k, states[np.round(spans * 200.0).astype(int)]
        places = at[:, :3] + 0.02 * rng.standard_normal((41, 3))
        believed = np.zeros(6)
        for _ in range(2):
            data = imu.at(graph, times, believed)  # forgets the last flight
            assert imu.counts.kept == len(t) and imu.counts.unknown == 0
            first = predict(at[0], imu.integrated(times, believed))
            start = {x: in_parts(first) if manifold is STATE else first, bias: np.tile(believed, (41, 1))}
            solution = run.solve(start, data={**data, fixes: places}, check=True)
            believed = solution[bias][20]
        error = solution[bias][-1] - true_bias
        scores.append(error @ np.linalg.solve(solution.covariance(bias[-1]), error))
        truth = in_parts(at) if manifold is STATE else at
        off = manifold.local(solution[x][-1], truth[-1])
        scores.append(off @ np.linalg.solve(solution.covariance(x[-1]), off))
        assert np.linalg.norm(off[:3]) < 0.1
    assert np.mean(scores) < 2.0 * 7.5 and np.max(scores) < 30.0


def test_a_window_slides_with_one_structure(rng: Generator) -> None:
    """Samples come out of order and twice; one is not a number; a second without samples is no information."""
    t, w, a, states = flight(6.0, rng, np.zeros(6))
    w[100] = np.nan
    lost = (t > 2.5) & (t < 3.5)
    nodes, step = 6, 0.2
    graph, x, bias, imu, fixes = estimator(nodes)
    start = graph.data("start", SE23.identity())
    graph.minimize(fg.prior, x[0], start, sigma=[0.05] * 6 + [0.02] * 3)
    run, program = LevenbergMarquardt().prepare(graph), graph.compile()
    fed, unknown = 0, []
    for tick in range(nodes - 1, 25):
        times = step * np.arange(tick - nodes + 1, tick + 1)
        ready = int(np.searchsorted(t, times[-1] + 1e-9))
        for k in rng.permutation(np.arange(max(fed - 1, 0), ready)):  # the last one again
            if not lost[k]:
                imu.add(t[k], w[k], a[k])
        fed = ready
        at = states[np.round(times * 200.0).astype(int)]
        data = {**imu.at(graph, times, np.zeros(6)), fixes: at[:, :3], start: at[0]}
        with counting() as tally:
            solution = run.solve({x: at, bias: np.zeros((nodes, 6))}, data=data)
        assert tick == nodes - 1 or not (tally.compiled or tally.generated)
        assert solution.converged or imu.counts.unknown, solution.report()
        assert graph.compile() is program
        unknown.append(imu.counts.unknown)
        if not unknown[-1]:
            assert np.abs(SE23.local(at, solution[x])).max() < 0.2
        assert imu.counts.kept <= (nodes - 1) * 40 + 3
    assert max(unknown) >= 5 and unknown[-1] == unknown[0] == 0
    assert imu.counts.invalid == 1 and imu.counts.repeated > 10


def test_order_of_arrival_changes_no_bit_of_the_data(rng: Generator) -> None:
    t, w, a = log_of(50, rng)
    answers = []
    for order in (np.arange(50), rng.permutation(50)):
        graph, _, _, imu, _ = estimator(3)
        for k in order:
            imu.add(t[k], w[k], a[k])
        answers.append(imu.at(graph, [0.01, 0.1, 0.2], np.zeros(6)))
    for mine, other in zip(*(answer.values() for answer in answers), strict=True):
        assert np.array_equal(mine, other)


@pytest.mark.parametrize(
    ("kind", "act", "words"),
    [
        (fg.GraphError, lambda graph, x, imu: InertialMeasurements(NOISE).at(fg.Graph(), [0.0, 1.0], NONE), "imu"),
        (
            ModelError,
            lambda graph, x, imu: InertialMeasurements(NOISE, bias="offset").state(graph, x),
            "neither SE23 nor the graph has a 'offset'",
        ),
        (ModelError, lambda graph, x, imu: InertialMeasurements(NOISE).state(graph, x[:1]), "a bias on"),
        (ModelError, lambda graph, x, imu: InertialMeasurements(NOISE).state(graph, x[:2]), "a bias on"),
        (ModelError, lambda graph, x, imu: InertialMeasurements(NOISE, bias="x").state(graph, x), "a bias on"),
        (ModelError, lambda graph, x, imu: imu.at(graph, [0.0, 1.0], NONE), "3 times are needed"),
        (
            ModelError,
            lambda graph, x, imu: imu.add([0.0, 1.0], np.zeros((2, 3)), np.zeros(3)),
            r"need rates and forces \(2, 3\)",
        ),
        (
            fg.GraphError,
            lambda graph, x, imu: imu.add(0.0, np.ma.masked_array(np.zeros(3), [True] * 3), np.zeros(3)),
            "rates is a masked",
        ),
        (fg.GraphError, lambda graph, x, imu: imu.add(0.0, 1j * np.ones(3), np.zeros(3)), "complex"),
        (ModelError, lambda graph, x, imu: InertialMeasurements(NOISE, gap=0.0), "must be positive"),
        (ModelError, lambda graph, x, imu: InertialMeasurements(NOISE, gap=np.nan), "must be positive"),
    ],
)
def test_misuse_of_the_bookkeeping_is_named(kind: type[Exception], act: Any, words: str) -> None:
    graph, x, _, imu, _ = estimator(3)
    with pytest.raises(kind, match=words):
        act(graph, x, imu)
    assert imu.counts == SampleCounts()


def test_refused_times_cost_no_sample_and_seconds_since_1970_are_named_in_full() -> None:
    graph, _, _, imu, _ = estimator(3)
    times = 1.7e9 + np.arange(3.0)
    imu.add(1.7e9 + np.arange(0.0, 5.0, 0.1), np.zeros((50, 3)), np.zeros((50, 3)))
    for wrong in (times[::-1], np.array([np.nan, *times[1:]])):
        with pytest.raises(ModelError, match="3 times are needed, finite and increasing, found"):
            imu.at(graph, wrong, NONE)
    imu.at(graph, times, NONE)
    assert imu.counts.unknown == 0 and imu.counts.kept == 50  # tenths of a second, rounded, are no longer than the gap
    imu.at(graph, times + 2.0, NONE)
    with pytest.raises(ModelError, match=r"nodes from 1700000000 s on are .* before 1700000002 s have been forgotten"):
        imu.at(graph, times, NONE)


def test_the_walk_of_biases_grows_with_the_root_of_time() -> None:
    sigma = NOISE.walk([0.25, 4.0])
    assert sigma.shape == (2, 6)
    np.testing.assert_allclose(sigma[0], [0.5e-4] * 3 + [0.5e-3] * 3)
    np.testing.assert_allclose(sigma[1], 4.0 * sigma[0])


def test_the_factor_is_compiled_with_exact_derivatives(rng: Generator) -> None:
    graph, x, bias, imu, _ = estimator(3)
    t, w, a = log_of(100, rng)
    imu.add(t, w, a)
    data = imu.at(graph, [0.0, 0.2, 0.4], NONE)
    routes = graph.check({x: SE23.random(rng, (3,)), bias: np.zeros((3, 6))}, data=data).routes
    assert "derivatives exact" in routes["imu"]
    assert inertial.motion().kernel is inertial.motion().kernel  # derived once
