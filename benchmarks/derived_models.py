"""Derived derivatives beside those written by hand: nanoseconds for one factor, model by model.

    python -m benchmarks.derived_models [--quick]

Both are called in the same compiled loop over two hundred factors, in random order, round by round; a ratio is the
median of its rounds, with the interval of its bootstrap. Where what ships is derived, the yardstick is the code that
shipped before (:mod:`benchmarks.hand_written`); where it is written by hand, its plain text stands here.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from benchmarks import hand_written
from benchmarks.report import table
from benchmarks.timing import interleave
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Argument, Kernel, evaluate_rows, side_by_side
from unifg.lie import SE2, SO3, Rn
from unifg.models import avoidance, landmarks, obstacles, quadrotor, unicycle, vehicle
from unifg.models.quadrotor import STATE
from unifg.typing import Array

FACTORS = 200
CAR = vehicle.Vehicle()


class Case(NamedTuple):
    """A model in both ways.

    Attributes:
        name: shown.
        derived: from plain NumPy.
        written: by hand.
        ships: which of them.
    """

    name: str
    derived: Kernel
    written: Kernel
    ships: str


def discs(x: Array, centre: Array, radius: Array) -> Array:
    """Distance to discs, cylinders or spheres, less their radii."""
    offset = x[:, None, : centre.shape[-1]] - centre
    distance: Array = np.sqrt(np.sum(offset * offset, axis=-1)) - radius
    return distance


def to_landmark(p: Array, l: Array, radius: Array) -> Array:  # noqa: E741
    """Distance to one cylinder."""
    return discs(p, l[:, None], radius[:, None])


def tilt(q: Array, z: Array) -> Array:
    """The vertical as the body sees it."""
    w, x, y, k = q[:, 0], q[:, 1], q[:, 2], q[:, 3]
    return np.stack([2 * (x * k - w * y), 2 * (y * k + w * x), 1 - 2 * (x * x + y * y)], axis=1) - z


def flown(x: Array, u: Array, after: Array, parameters: Array, h: Array) -> Array:
    """Defect of the simplified trapezoid of the quadrotor."""
    p = parameters
    still = np.zeros((len(x), 6))
    return disturbed(x, u, still, p[:, :1], p[:, 1:4], p[:, 4:6], p[:, 6:], after, h)


def disturbed(x: Array, u: Array, w: Array, *rest: Array) -> Array:
    """The same with noise and parameters to be found."""
    *rho, after, h = rest
    half = 0.5 * h[:, None]
    speeds = quadrotor.field(x, u, w, *rho) + quadrotor.field(after, u, w, *rho)
    turn = SO3.local(x[:, 3:7], after[:, 3:7])
    return np.concatenate([after[:, :3] - x[:, :3], turn, after[:, 7:] - x[:, 7:]], axis=1) - half * speeds


def kept(name: str, plain: Callable[..., Array], residual: Any, arguments: tuple[Argument, ...], rows: int) -> Case:
    """A model that ships as it is written by hand."""
    return Case(name, StatedKernel(plain, arguments, rows, name=name), residual.kernel, "by hand")


def replaced(name: str, residual: Any, written: Kernel, ships: str = "derived") -> Case:
    """A model that ships derived."""
    kernel = residual.kernel
    return Case(name, StatedKernel(kernel.function, kernel.arguments, kernel.rows, name=name), written, ships)


def cases() -> list[Case]:
    """All models with derivatives of their own."""
    flight: tuple[Argument, ...] = (STATE, quadrotor.CONTROL, STATE, (7,), ())
    unknown: tuple[Argument, ...] = (
        STATE, quadrotor.CONTROL, quadrotor.NOISE, quadrotor.MASS, quadrotor.DRAG, quadrotor.WIND, quadrotor.UPDRAFT,
        STATE, (),
    )  # fmt: skip
    found = [
        replaced("unicycle.dynamics", unicycle.dynamics, hand_written.dynamics),
        replaced("unicycle.tracking", unicycle.tracking, hand_written.tracking),
        replaced("vehicle.dynamics", vehicle.dynamics(CAR), hand_written.vehicle(CAR)),
        replaced("landmarks.bearing_range", landmarks.bearing_range, hand_written.bearing_range, "derived, S by hand"),
        kept("landmarks.tilt", tilt, landmarks.tilt, (SO3, (3,)), 3),
        kept("avoidance.landmark_clearance", to_landmark, avoidance.landmark_clearance, (Rn(3), Rn(2), ()), 1),
        kept("quadrotor.dynamics", flown, quadrotor.dynamics, flight, 9),
        kept("quadrotor.disturbed_dynamics", disturbed, quadrotor.disturbed_dynamics, unknown, 9),
    ]
    for m in (1, 8, 32):
        for where, clearance, size, name in (
            (SE2, obstacles.disc_clearance, 2, "obstacles.disc_clearance"),
            (Rn(3), avoidance.cylinder_clearance, 2, "avoidance.cylinder_clearance"),
            (Rn(3), avoidance.sphere_clearance, 3, "avoidance.sphere_clearance"),
        ):
            found.append(kept(f"{name}, {m}", discs, clearance, (where, (m, size), (m,)), m))
    return found


def measure(case: Case, rounds: int) -> list[str]:
    """One row of the table."""
    rng = np.random.default_rng(0)
    arguments = case.derived.arguments
    drawn = [
        rng.normal(size=(FACTORS, *a)) + 2.0 if isinstance(a, tuple) else a.random(rng, (FACTORS,))  # type: ignore[union-attr]
        for a in arguments
    ]
    v = side_by_side([d for d, a in zip(drawn, arguments, strict=True) if not isinstance(a, tuple)])
    p = side_by_side([d for d, a in zip(drawn, arguments, strict=True) if isinstance(a, tuple)] or [np.zeros((1, 0))])
    rows, width = case.derived.size([]), sum(m.dim for m in case.derived.manifolds)
    begin = time.process_time()
    codes = {"r": case.derived.address, "S": case.derived.second_address}
    stated = 1e3 * (time.process_time() - begin)
    line = [f"`{case.name}`", case.ships]
    for what in ("r", "r + J", "S"):
        if what == "S" and not (codes["S"] and case.written.second_address):
            line.append("")
            continue
        r = rng.normal(size=(FACTORS, rows))
        J = np.zeros({"r": (0, 0, width), "r + J": (FACTORS, rows, width), "S": (FACTORS, width, width)}[what])

        def run(kernel: Kernel, what: str = what, r: Array = r, J: Array = J) -> float:
            where = kernel.second_address if what == "S" else kernel.address
            begin = time.perf_counter()
            evaluate_rows(where, v, p, kernel.table, r, J)
            return (time.perf_counter() - begin) / FACTORS * 1e9

        times = interleave({"derived": partial(run, case.derived), "written": partial(run, case.written)}, rounds)
        ratio = times["derived"] / times["written"]
        low, high = np.percentile([np.median(rng.choice(ratio, len(ratio))) for _ in range(500)], [2.5, 97.5])
        both = " / ".join(f"{np.median(times[name]):.0f}" for name in ("derived", "written"))
        line.append(f"{both}: {np.median(ratio):.2f} ({low:.2f}-{high:.2f})")
    return [*line, f"{stated:.0f}"]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few rounds")
    rounds = 20 if parser.parse_args().quick else 200
    header = ["model", "ships", "r [ns]", "r + J [ns]", "second derivatives S [ns]", "generated in [ms]"]
    print(table(header, [measure(case, rounds) for case in cases()]))


if __name__ == "__main__":
    main()
