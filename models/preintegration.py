"""IMU preintegration: relative motion between two nodes, independent of the state.

Forster, Carlone, Dellaert, Scaramuzza 2017, *On-manifold preintegration for real-time visual-inertial odometry*, in the
exact form of Brossard, Barrau, Chauchat, Bonnabel 2021, *Associating uncertainty to extended poses for on Lie group IMU
preintegration with rotating Earth*. With rates omega and specific forces a in the axes of the body, a state (p, v, R)
moves over a time h by

    x_next = Gamma_h Phi_h(x) Y,    Phi_h(p, v, R) = (p + h v, v, R),    Gamma_h = (h^2 g / 2, h g, I),

where Y in SE_2(3) depends on what was measured, and on biases, alone. Held over a sample of length t they give exactly

    Y = (Gamma_2(t omega) a t^2, Gamma_1(t omega) a t, Exp(t omega)),    Gamma_m(phi) = sum_n [phi]x^n / (n + m)!

and Y <- Phi_t(Y) Y_sample. As Phi_t is an automorphism, an error in Y, Y Exp(xi), goes on linearly and exactly,

    xi <- Ad(Y_sample^-1) F_t xi + G n,    F_t (rho, nu, theta) = (rho + t nu, nu, theta),

G the derivative of Y_sample by what was measured. So do the covariance and, with -G, the derivative by the biases.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from unifg.codegen.jit import compiled
from unifg.errors import ModelError, require_kinds
from unifg.lie import SE23, SO3, Product, Rn, se3, se23, so3
from unifg.lie.series import c_slope, c_value
from unifg.modeling.duplicates import doubles
from unifg.typing import Array, ArrayLike

__all__ = ["BIAS", "ImuNoise", "at_rest", "predict", "preintegrate"]

BIAS = Product(gyro=Rn(3), accelerometer=Rn(3))
"""What the sensors show too much of: rates [rad/s] and specific forces [m/s^2], in the axes of the body."""
GRAVITY = (0.0, 0.0, -9.81)
"""In the world [m/s^2]."""
NEAR = 1.0  # squared angle [rad^2] below which Gamma_2 is a power series
TERMS = 10
CLOSE = 1e-6  # of an interval: how much later than its node the first sample may be
DENSITIES = 1e-9, 1e3  # between which noise is: the best gyros have 1e-7 rad/s/sqrt(Hz)
INVERTED = 1e-3  # by how much a covariance times its inverse, both without units, may differ from the identity


@dataclass(frozen=True)
class ImuNoise:
    """Densities of noise that is white in continuous time, as data sheets have them; defaults of a small MEMS sensor.

    Attributes:
        gyro: of rates [rad/s/sqrt(Hz)], from 1e-9 to 1e3.
        accelerometer: of specific forces [m/s^2/sqrt(Hz)], from 1e-9 to 1e3.
        gyro_walk: of the random walk of the gyro's bias [rad/s^2/sqrt(Hz)]; zero where one bias stays.
        accelerometer_walk: of that of the accelerometer's [m/s^3/sqrt(Hz)]; zero where one bias stays.

    Raises:
        ModelError: when a density is none; of rates and forces zero is none: without noise there is no information.
    """

    gyro: float = 1.7e-4
    accelerometer: float = 2e-3
    gyro_walk: float = 2e-5
    accelerometer_walk: float = 3e-3

    def __post_init__(self) -> None:
        """Look at the densities."""
        require_kinds("ImuNoise", ModelError, type(self).__annotations__, vars(self))
        least, most = DENSITIES
        for name in ("gyro", "accelerometer"):
            if not least <= getattr(self, name) <= most:
                raise ModelError(
                    f"ImuNoise: {name} {getattr(self, name)!r} must be a density from {least:g} to {most:g}; give that "
                    "of the data sheet, or of a simulation without noise a small one, as 1e-6"
                )
        for name in ("gyro_walk", "accelerometer_walk"):
            if not 0.0 <= getattr(self, name) <= most:
                raise ModelError(f"ImuNoise: {name} {getattr(self, name)!r} must be a density from 0 to {most:g}")

    def walk(self, duration: ArrayLike) -> Array:
        """(n, 6) standard deviations of the change of biases over (n,) durations [s]."""
        densities = np.repeat([self.gyro_walk, self.accelerometer_walk], 3)
        sigma: Array = np.sqrt(np.reshape(np.asarray(duration, dtype=np.float64), (-1, 1))) * densities
        return sigma


class Preintegrated(NamedTuple):
    """The motion over n intervals, one row each; the first four are what :func:`unifg.models.inertial.motion` takes.

    Attributes:
        increment: (n, 10) Y, elements of SE23.
        by_bias: (n, 9, 6) derivatives of Y, Y Exp(by_bias d), by the biases.
        bias: (n, 6) biases at which the increments were found.
        duration: (n,) [s].
        covariance: (n, 9, 9) of the errors xi, Y Exp(xi).
        held: (n,) for how long a sample was held at most [s]; infinite where the interval begins before the first.
    """

    increment: Array
    by_bias: Array
    bias: Array
    duration: Array
    covariance: Array
    held: Array

    @property
    def information(self) -> Array:
        """(n, 9, 9) inverses of the covariances; zero where nothing was measured.

        Raises:
            ModelError: when a covariance has no inverse in double precision: densities lie too far apart.
        """
        found = np.zeros_like(self.covariance)
        scale = np.sqrt(np.einsum("nii->ni", self.covariance))
        known = (scale > 0.0).all(axis=1)
        per = 1.0 / scale[known]  # entries differ by powers of the sampling time
        both = per[:, :, None] * per[:, None, :]
        alike = both * self.covariance[known]
        try:
            inverse = np.linalg.inv(alike)
        except np.linalg.LinAlgError:
            inverse = np.full_like(alike, np.nan)
        off = np.abs(inverse @ alike - np.eye(9)).max(axis=(1, 2))
        if not (off < INVERTED).all():
            raise ModelError(
                "a covariance has no inverse in double precision: the noise densities of gyro and accelerometer lie "
                "too far apart"
            )
        inverse = both * inverse
        found[known] = 0.5 * (inverse + np.swapaxes(inverse, 1, 2))
        return found


def preintegrate(
    stamps: ArrayLike, gyro: ArrayLike, accelerometer: ArrayLike, times: ArrayLike, noise: ImuNoise, bias: ArrayLike
) -> Preintegrated:
    """Integrate the samples between nodes.

    A sample is held from its stamp to that of the next one, the last one up to the last node. Nodes may lie anywhere:
    samples are cut there. Over an interval that begins before the first sample nothing is known; it has no information.

    Args:
        stamps: (k,) of the samples, increasing [s].
        gyro: (k, 3) rates [rad/s].
        accelerometer: (k, 3) specific forces [m/s^2]: at rest minus gravity, upwards.
        times: (n + 1,) of the nodes, increasing [s].
        noise: of the sensors.
        bias: (6,) or (n, 6), where to begin; a factor corrects to first order for others.

    Raises:
        ModelError: on other shapes, numbers that are not finite, or stamps or times that do not increase.
        GraphError: on masked arrays, and what is no real number.
    """
    require_kinds("preintegrate", ModelError, preintegrate.__annotations__, {"noise": noise}, ImuNoise)
    t, at = np.array(doubles("stamps", stamps)), np.array(doubles("times of nodes", times))
    w, a = (np.ascontiguousarray(doubles(*part)) for part in (("rates", gyro), ("specific forces", accelerometer)))
    if t.ndim != 1 or w.shape != (len(t), 3) or a.shape != (len(t), 3):
        raise ModelError(f"preintegrate: {t.shape} stamps need (k, 3) rates and forces, found {w.shape}, {a.shape}")
    if at.ndim != 1 or len(at) < 2:
        raise ModelError(f"preintegrate: two or more node times are needed, found {at.shape}")
    for name, part in (("stamps", t), ("times", at)):
        if not (np.isfinite(part).all() and (np.diff(part) > 0.0).all()):
            raise ModelError(f"preintegrate: {name} must be finite and increase")
    n = len(at) - 1
    b = doubles("biases", bias)
    if b.shape not in ((6,), (n, 6)):
        raise ModelError(f"preintegrate: a bias is (6,), of rates and of forces, or ({n}, 6); found {b.shape}")
    b = np.array(np.broadcast_to(b, (n, 6)), order="C")
    if not (np.isfinite(w).all() and np.isfinite(a).all() and np.isfinite(b).all()):
        raise ModelError("preintegrate: rates, forces and biases must be finite; leave out samples that are not")
    density = np.array([noise.gyro, noise.accelerometer])
    found = Preintegrated(
        np.tile(SE23.identity(), (n, 1)), np.zeros((n, 9, 6)), b, np.diff(at), np.zeros((n, 9, 9)), np.full(n, np.inf)
    )
    _integrate(t, w, a, at, b, density**2, found.increment, found.by_bias, found.covariance, found.held)
    return found


def predict(x: ArrayLike, motion: Preintegrated, gravity: ArrayLike = GRAVITY) -> Array:
    """(n + 1, 10) states of SE23 that follow from the first, (10,), at the biases of the integration.

    Raises:
        ModelError: for a state or a gravity of another shape.
    """
    g, first = np.array(down(gravity)), np.asarray(x, dtype=np.float64)
    if first.size != SE23.storage:
        raise ModelError(f"predict: the first state is one of SE23, (10,), found {first.shape}")
    states = np.empty((len(motion.duration) + 1, 10))
    states[0] = first.ravel()
    for k, (increment, h) in enumerate(zip(motion.increment, motion.duration, strict=True)):
        drifted = states[k].copy()
        drifted[:3] += h * (drifted[3:6] + 0.5 * h * g)
        drifted[3:6] += h * g
        states[k + 1] = SE23.compose(drifted, increment)
    return states


def down(gravity: ArrayLike) -> tuple[float, ...]:
    """Gravity as three numbers."""
    found = np.asarray(gravity, dtype=np.float64)
    if found.shape != (3,) or not np.isfinite(found).all():
        raise ModelError(f"gravity must be three finite numbers, found {gravity!r}")
    return tuple(found.tolist())


@compiled
def gamma(t: float) -> tuple[float, float]:
    """Return e and its slope e' / theta of a squared angle t, where Gamma_2 = I / 2 + c W + e W^2.

    e = (t / 2 + cos(theta) - 1) / t^2, which is 0 / 0 at zero; its derivative over theta is (c - 4 e) / t.
    """
    if t < NEAR:
        factorial, power, value, slope = 24.0, 1.0, 0.0, 0.0
        for k in range(TERMS):
            value += power / factorial
            after = factorial * (2.0 * k + 5.0) * (2.0 * k + 6.0)
            slope -= 2.0 * (k + 1.0) * power / after
            factorial, power = after, -t * power
        return value, slope
    theta = math.sqrt(t)
    c = (theta - math.sin(theta)) / (t * theta)
    value = (0.5 * t + math.cos(theta) - 1.0) / (t * t)
    return value, (c - 4.0 * value) / t


@compiled
def sample(w: Array, a: Array, h: float, out: Array, G: Array) -> None:
    """Write Y of rates and forces held for h, (10,), and its derivative by them in the tangent of Y, (9, 6)."""
    d, moved, J, R = np.empty(6), np.empty(7), np.empty((6, 6)), np.empty((3, 3))
    for k in range(3):
        d[k], d[3 + k] = h * a[k], h * w[k]
    se3.exp(d, moved)
    se3.right_jacobian(d, J)
    so3.write_matrix(moved[3], moved[4], moved[5], moved[6], R, 0)
    x, y, z = d[3], d[4], d[5]
    t = x * x + y * y + z * z
    theta = max(math.sqrt(t), 1e-150)
    a0, b0 = math.sin(theta) / theta, 2.0 * (math.sin(0.5 * theta) / theta) ** 2
    c = c_value(theta, a0 * theta)
    rise, (e, bend) = c_slope(t, b0, c), gamma(t)
    phi, force = d[3:], d[:3]
    along = phi[0] * force[0] + phi[1] * force[1] + phi[2] * force[2]
    once = np.array([y * force[2] - z * force[1], z * force[0] - x * force[2], x * force[1] - y * force[0]])
    by_phi, by_force = np.empty((3, 3)), np.empty((3, 3))  # of Gamma_2(phi) force
    for i in range(3):
        twice = phi[i] * along - t * force[i]
        out[i] = h * (0.5 * force[i] + c * once[i] + e * twice)
        for k in range(3):
            by_force[i, k] = e * phi[i] * phi[k]
            by_phi[i, k] = (rise * once[i] + bend * twice) * phi[k] + e * (phi[i] * force[k] - 2.0 * force[i] * phi[k])
        by_force[i, i] += 0.5 - e * t
        by_phi[i, i] += e * along
    for i, k, sign in ((0, 1, -1.0), (1, 0, 1.0), (0, 2, 1.0), (2, 0, -1.0), (1, 2, -1.0), (2, 1, 1.0)):
        other = 3 - i - k
        by_force[i, k] += sign * c * phi[other]
        by_phi[i, k] -= sign * c * force[other]
    for i in range(3):
        out[3 + i], out[6 + i] = moved[i], moved[3 + i]
        for k in range(3):
            turned, pushed = 0.0, 0.0
            for j in range(3):  # into the axes of the end: R'
                turned += R[j, i] * by_phi[j, k]
                pushed += R[j, i] * by_force[j, k]
            G[i, k], G[i, 3 + k] = h * h * turned, h * h * pushed
            G[3 + i, k], G[3 + i, 3 + k] = h * J[i, 3 + k], h * J[i, k]
            G[6 + i, k], G[6 + i, 3 + k] = h * J[i, k], 0.0
    out[9] = moved[6]


@compiled
def _integrate(
    stamps: Array, gyro: Array, accelerometer: Array, times: Array, bias: Array, density: Array,
    increment: Array, by_bias: Array, covariance: Array, held: Array,
) -> None:  # fmt: skip
    """All intervals; what is written begins as the identity, zeros and infinity."""
    Y, back, G, A = np.empty(10), np.empty(10), np.empty((9, 6)), np.empty((9, 9))
    w, a, carried = np.empty(3), np.empty(3), np.empty((9, 9))
    first = 0
    for n in range(len(times) - 1):
        if len(stamps) == 0 or stamps[0] > times[n] + CLOSE * (times[n + 1] - times[n]):
            continue
        while first + 1 < len(stamps) and stamps[first + 1] <= times[n]:
            first += 1
        k, now, whole, longest = first, times[n], increment[n], 0.0
        while now < times[n + 1]:
            until = times[n + 1]
            if k + 1 < len(stamps) and stamps[k + 1] < until:
                until = stamps[k + 1]
            h = until - now
            longest = max(longest, until - stamps[k])
            for i in range(3):
                w[i], a[i] = gyro[k, i] - bias[n, i], accelerometer[k, i] - bias[n, 3 + i]
            sample(w, a, h, Y, G)
            for i in range(3):
                whole[i] += h * whole[3 + i]
            se23.compose(whole, Y, whole)
            se23.inverse(Y, back)
            se23.adjoint(back, A)
            for i in range(9):
                for j in range(3):
                    A[i, 3 + j] += h * A[i, j]
            _products(A, by_bias[n], carried)
            for i in range(9):
                for j in range(6):
                    by_bias[n, i, j] = carried[i, j] - G[i, j]
            _products(A, covariance[n], carried)
            _products(A, carried.T, covariance[n])
            _add_noise(G, density, h, covariance[n])
            now, k = until, k + 1
        held[n] = longest


@compiled
def _products(A: Array, B: Array, out: Array) -> None:
    """Write A B into the first columns of ``out``."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[k, j]
            out[i, j] = total


@compiled
def _add_noise(G: Array, density: Array, h: float, P: Array) -> None:
    """Add G Q G' / h, and what white noise does to the position inside the sample beyond its mean: h^3 / 12."""
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(6):
                total += G[i, k] * density[k // 3] * G[j, k]
            P[i, j] += total / h
    for i in range(3):
        P[i, i] += density[1] * h**3 / 12.0


def at_rest(rotation: ArrayLike, gravity: ArrayLike = GRAVITY) -> Array:
    """(..., 3) specific forces that an accelerometer shows at rest, [m/s^2], for orientations (..., 4)."""
    return SO3.act(SO3.inverse(rotation), -np.array(down(gravity)))
