"""The gains of those who fly along a path, each tuned by the same search: ``python -m benchmarks.flight_tuning``.

Both fly figure eights at 2 and 3 m/s, a few seconds each, with a seed that no test and no table uses, and with equal
knowledge. What is made small is the mean over the flights of the root mean square distance from the path. The search
goes along one number after the other, up and down by a factor that shrinks when no step helps:

    factors 1.6, then 1.25 (gains), 3, then 1.6 (weights); at most six rounds each; a step must help by half a percent

Every step that helps is printed. Of the weights only ratios count: the first stays. The numbers stand in
``flatness.TUNED``, after 128 evaluations, and in ``keeper.TRACKING``, after 105, some of either by hand; no neighbour
of either is better by a percent then.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from unifg.scenarios.log.metrics import errors
from unifg.scenarios.safe_flight import Controller, SafeFlight, SafeSettings
from unifg.scenarios.safety.flatness import Gains
from unifg.scenarios.safety.situations import situation
from unifg.typing import Array

SPEEDS = (2.0, 3.0)
SEEDS = (9001,)
SECONDS = {"flatness": 5.0, "barrier": 5.0}
FACTORS = {"flatness": (1.6, 1.25), "barrier": (3.0, 1.6)}
ROUNDS = 6
HELPS = 0.005
WEIGHTS = ("position", "attitude", "velocity", "rate", "thrust", "rate_change", "thrust_change")
START = {"flatness": Gains().packed, "barrier": np.array([180.0, 5e-3, 0.1, 8e-4, 2.5e-4, 4e-6, 1e-3])}
FREE = {"flatness": 0, "barrier": 1}  # the first number that is tuned


def search(
    cost: Callable[[Array], float], start: Array, factors: tuple[float, ...], free: int = 0
) -> tuple[Array, float]:
    """Positive numbers (k,) near ``start`` with a small cost, and the cost."""
    best, least = start, cost(start)
    for factor in factors:
        for _ in range(ROUNDS):
            before = least
            for k in range(free, len(best)):
                for scale in (factor, 1.0 / factor):
                    tried = best.copy()
                    tried[k] *= scale
                    if (found := cost(tried)) < (1.0 - HELPS) * least:
                        best, least = tried, found
                        print(f"{1e3 * least:.3f} mm at {np.array2string(best, precision=3)}", flush=True)
                        break
            if least == before:
                break
    return best, least


def with_numbers(controller: Controller, numbers: Array) -> SafeSettings:
    """Settings with gains or weights of a controller."""
    settings = SafeSettings(case="figure8")
    if controller == "flatness":
        return replace(settings, gains=Gains.unpacked(numbers))
    weights = dict(zip(WEIGHTS, numbers.tolist(), strict=True))
    return replace(settings, tracking=replace(settings.tracking, **weights))


def tracking_error(controller: Controller, numbers: Array, seconds: float) -> float:
    """Mean over the flights of the distance from the path [m]; a flight that is lost costs a metre."""
    settings, found = with_numbers(controller, numbers), []
    for speed in SPEEDS:
        about = replace(situation("figure8", speed), duration=seconds)
        for seed in SEEDS:
            log = SafeFlight(replace(settings, seed=seed), about, controller, (1.0, 0.0), "", speed).run()
            error = errors(log.error[log.time >= 2.0])["rms"]
            found.append(error if np.isfinite(error) else 1.0)
    return float(np.mean(np.minimum(found, 1.0)))


def main() -> None:
    """Tune one or both, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--controller", choices=("flatness", "barrier"), action="append")
    parser.add_argument("--seconds", type=float, help="of each flight")
    options = parser.parse_args()
    for controller in options.controller or ("flatness", "barrier"):
        cost = partial(tracking_error, controller, seconds=options.seconds or SECONDS[controller])
        numbers, least = search(cost, START[controller], FACTORS[controller], FREE[controller])
        print(f"{controller}: {np.array2string(numbers, precision=4, separator=', ')}, {1e3 * least:.2f} mm")


if __name__ == "__main__":
    main()
