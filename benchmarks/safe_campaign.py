"""Random flights of one case, and whether those that came too near could have done better.

``python -m benchmarks.safe_campaign --case ellipse --flights 100`` flies seeds from 1 on and prints a line for each,
and a count. The oracle is asked when an obstacle is first seen with a velocity: at the start, and when a ball leaves
the hand. A margin that is not kept counts against the controller unless the oracle does not say "yes" then.
"""

from __future__ import annotations

import argparse

import numpy as np

from unifg.models.quadrotor import GRAVITY
from unifg.scenarios.log.safe_log import SafeLog
from unifg.scenarios.safe_flight import CONTROLLERS, SafeFlight, SafeSettings, flights
from unifg.scenarios.safety.oracle import Answer, Authority, exists
from unifg.scenarios.safety.situations import SITUATIONS
from unifg.scenarios.worlds.bodies import Ellipse, Thrown

VEHICLE = 5.0  # horizontal acceleration at a tilt of 27 degrees [m/s^2]
TILT = 0.15  # time to get there [s]
ANSWERS: tuple[Answer, ...] = ("no", "unknown", "yes")


def could(flight: SafeFlight, log: SafeLog) -> Answer:
    """Whether a safe control existed when each body was first seen with its velocity: the worst of the answers."""
    worst = len(ANSWERS) - 1
    for body in flight.situation.bodies.bodies:
        motion = body.motion
        ball = motion if isinstance(motion, Thrown) else None
        first = ball.release if ball else 0.0
        bend = motion.greatest_acceleration if isinstance(motion, Ellipse) else 0.0
        place, velocity = motion.at(np.array([first + 1e-6]))
        state = log.states[min(int(np.ceil(first / log.dt)), log.ticks - 1)]
        axes = 2 if body.upright else 3
        away, speed = (state[:3] - place[0])[:axes], (state[7:] - velocity[0])[:axes]
        authority = Authority(
            VEHICLE,
            0.1,
            flight.settings.books.loops.delay + flight.settings.dt + TILT,
            bend,
            ball.flight if ball else 3.0,
        )
        pull = np.array([0.0, 0.0, -GRAVITY]) if ball else None
        keep = body.radius + log.hull + log.margin
        worst = min(worst, ANSWERS.index(exists(away, speed, keep, authority, pull)))
    return ANSWERS[worst]


def main() -> None:
    """Fly, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=SITUATIONS, default="static")
    parser.add_argument("--controller", choices=CONTROLLERS, default="barrier")
    parser.add_argument("--alpha", type=float, default=1.2)
    parser.add_argument("--gamma", type=float, default=0.0)
    parser.add_argument("--flights", type=int, default=100)
    options = parser.parse_args()
    bad = excused = short = 0
    times = []
    for seed in range(1, options.flights + 1):
        alpha, gamma, who = (options.alpha,), (options.gamma,), (options.controller,)
        settings = SafeSettings(case=options.case, alpha=alpha, gamma=gamma, controller=who, seed=seed)
        (flight,) = flights(settings)
        log = flight.run()
        answer = could(flight, log)
        bad += log.violated and answer == "yes"
        excused += log.violated and answer != "yes"
        short += not log.arrived
        times.append(log.decide_ms)
        print(
            f"{seed}: boundary distance {1e3 * log.boundary.min():.1f} mm, slack {1e3 * log.slack.max():.1f} mm, "
            f"safe control: {answer}, {'arrived' if log.arrived else 'NOT THERE'}",
            flush=True,
        )
    every = np.concatenate(times)
    quantiles = ", ".join(f"{np.percentile(every, q):.2f}" for q in (50.0, 99.0, 99.9))
    print(
        f"{options.case}, {options.controller}: {options.flights} flights, margin not kept {bad} where it could have "
        f"been, {excused} elsewhere; {short} did not arrive; {len(every)} ticks, median, p99, p99.9: {quantiles} ms"
    )


if __name__ == "__main__":
    main()
