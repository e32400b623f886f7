"""Plans that go where they learn: the error at the goal against the time it costs, paired over layouts.

    python -m benchmarks.active_perception [--seeds 100:110] [--drives 300] [--workers K] [--fresh] [--report]

On each random layout of discs and of beacons beside the way a unicycle drives to a goal in the dark. One plan has the
predicted deviation at the goal in its cost, with the weight swept; another counts on near sightings only; the rule of
thumb is the fastest way that passes one of the beacons within a distance, of which the best beacon and distance are
taken. All are driven with a filter, feedback and noise, on the same random numbers. Layouts are the random effect:
intervals are bootstrapped over them. Writes docs/active-perception.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

import unifg as fg
from benchmarks import runs
from benchmarks.comparison import Row, where
from benchmarks.covariance_plans import difference, mean
from benchmarks.report import command, machine, publish, table
from problems import belief_plans
from problems.belief_plans import SENSOR, Guess, Layout, Plan, Planner

MARGIN = 0.3  # from discs, of all plans [m]
WEIGHTS = (3.0, 10.0, 30.0)  # of the deviation at the goal [s/m]
PASSES = (2.0, 1.2, 0.6)  # distances at which a rule passes a beacon [m]
DISCS = 3
WAYS: dict[str, tuple[str, ...]] = {
    "rule": tuple(f"{distance:g}" for distance in PASSES),
    "in the cost": tuple(f"{weight:g}" for weight in WEIGHTS),
    "cautious": tuple(f"{weight:g}" for weight in WEIGHTS),
}
UNITS = {"rule": "m", "in the cost": "s/m", "cautious": "s/m"}
CAUTIOUS = replace(SENSOR, reach=1.5)
"""What a cautious plan counts on: sightings a metre within the reach, since it will not be where it plans to be."""
COLUMNS = {
    "time [s]": ("time", 1.0),
    "error at the goal, rms [cm]": ("error", 100.0),
    "foreseen [cm]": ("foreseen", 100.0),
    "distance from the goal, rms [cm]": ("miss", 100.0),
    "collisions [%]": ("collisions", 100.0),
}
TARGETS = (0.7, 0.5, 0.35)  # errors at the goal, rms [m]
LONGER = (0.3, 1.0, 3.0)  # than the fastest plan [s]


@dataclass(frozen=True)
class Job:
    """One layout, planned in one way, and how often each plan is driven."""

    seed: int
    way: str
    drives: int


def dark(seed: int) -> Layout:
    """A way in the dark: few discs on it, and two beacons so far beside it that it hardly meets their light."""
    rng, among = np.random.default_rng(seed), belief_plans.layout(seed, DISCS)
    beacons = np.stack([rng.uniform(3.0, 7.5, 2), rng.choice([-1.0, 1.0], 2) * rng.uniform(2.8, 4.5, 2)], axis=1)
    return Layout(among.discs, among.radii, beacons)


def planned(job: Job) -> list[tuple[str, Plan | None]]:
    """Plans of one way, by the words that name their settings."""
    world = dark(job.seed)
    if job.way != "rule":
        planner = Planner(world, sensor=SENSOR if job.way == "in the cost" else CAUTIOUS)

        def solve(guess: Guess | fg.Solution, weight: float) -> tuple[fg.Solution, Plan | None]:
            return planner.solve(guess, MARGIN, arrival=weight)

        starts = [planner.guess(side) for side in (-2.0, 2.0)]
        starts += [planner.past(beacon)[0] for beacon in world.beacons]
        found = belief_plans.sweep(planner, solve, WEIGHTS, starts)
        return [(f"{weight:g}", plan) for weight, plan in zip(WEIGHTS, found, strict=True)]
    planner, plans = Planner(world, foresees=False, via=True), list[tuple[str, Plan | None]]()
    free = planner.within.value
    for beacon in world.beacons:
        guess, node = planner.past(beacon)
        for distance in PASSES:
            within = free.copy()
            within[node - 1] = distance
            _, plan = planner.solve(guess, MARGIN, place=beacon, within=within)
            plans.append((f"{distance:g}", plan))
    return plans


def attempt(job: Job) -> Row:
    """Plan in one way, and drive all plans."""
    world = dark(job.seed)
    found: list[Row] = []
    for words, plan in planned(job):
        if plan is None:
            continue
        drives = belief_plans.drive(plan, world, job.drives, job.seed)
        found.append(
            {
                "setting": words,
                "time": plan.duration,
                "foreseen": float(plan.deviation[-1]),
                "error": float(np.sqrt(np.mean(drives.arrival**2))),
                "miss": float(np.sqrt(np.mean(drives.miss**2))),
                "collisions": drives.collisions,
            }
        )
    return {"found": found}


class Campaign:
    """What was found, by way and layout.

    Attributes:
        seeds: layouts that all ways have met.
    """

    def __init__(self, rows: list[Row], drives: int) -> None:
        """Sort the rows of some drives per plan."""
        ways = {way: {row["seed"]: row["found"] for row in where(rows, way=way, drives=drives)} for way in WAYS}
        self.seeds = sorted(set[int].intersection(*(set(found) for found in ways.values())))
        self._found = {way: [found[seed] for seed in self.seeds] for way, found in ways.items()}

    def of(self, way: str, setting: str, what: str) -> list[float]:
        """A number of each layout, of the fastest plan with a setting; not a number where there is none."""
        return [
            min(((row["time"], row[what]) for row in found if row["setting"] == setting), default=(0.0, np.nan))[1]
            for found in self._found[way]
        ]

    def fastest(self, way: str, target: float) -> list[float]:
        """The least time of each layout among all plans whose drives end with no more than a target's error."""
        return [
            min((row["time"] for row in found if row["error"] <= target), default=np.nan) for found in self._found[way]
        ]

    def surest(self, way: str, longer: float) -> list[float]:
        """The least error of each layout among all plans that take no more than this beyond the fastest of any way."""
        least = [
            min((row["time"] for way in WAYS for row in self._found[way][i]), default=np.nan)
            for i in range(len(self.seeds))
        ]
        return [
            min((row["error"] for row in found if row["time"] <= time + longer), default=np.nan)
            for found, time in zip(self._found[way], least, strict=True)
        ]


def render(found: Campaign, drives: int) -> str:
    """Markdown of all settings, and of both ways at equal error and at equal time."""
    lines = [
        [
            f"{way}, {setting} {UNITS[way]}",
            *(mean(found.of(way, setting, what), scale) for what, scale in COLUMNS.values()),
        ]
        for way, settings in WAYS.items()
        for setting in settings
    ]
    count, base = len(found.seeds), "rule"
    error, late, beside = [], [], [f"{way}, to the rule" for way in WAYS if way != base]
    for target in TARGETS:
        times = {way: found.fastest(way, target) for way in WAYS}
        kept = [f"{np.isfinite(times[way]).sum()} / {count}" for way in WAYS]
        against = [difference(times[way], times[base]) for way in WAYS if way != base]
        error.append([f"{100.0 * target:g} cm", *kept, *against])
    for longer in LONGER:
        errors = {way: [100.0 * value for value in found.surest(way, longer)] for way in WAYS}
        against = [difference(errors[way], errors[base]) for way in WAYS if way != base]
        late.append([f"{longer:g} s", *(mean(errors[way]) for way in WAYS), *against])
    return "\n\n".join(
        [
            machine("numpy", "scipy", "osqp", "piqp", "numba"),
            f"{count} layouts, {drives} drives of each plan; in brackets 95 % intervals over layouts. The rule's lines "
            "are those of the beacon that takes the least time.",
            "### Every setting",
            table(["plan", *COLUMNS], lines),
            "### The fastest plan of each layout that ends with no more error",
            table(["error, rms", *(f"reached, {way}" for way in WAYS), *beside], error),
            "### The surest plan of each layout in a time",
            table(["beyond the fastest", *(f"error, {way} [cm]" for way in WAYS), *beside], late),
        ]
    )


def main(arguments: list[str] | None = None) -> int:
    """Run what is missing and rewrite docs/active-perception.md."""
    parser = command(__doc__)
    runs.options(parser)
    parser.add_argument("--seeds", type=runs.seeds, default=range(100, 110), metavar="FIRST:END")
    parser.add_argument("--drives", type=int, default=300, help="of each plan")
    options = parser.parse_args(arguments)
    jobs = [Job(seed, way, options.drives) for seed in options.seeds for way in WAYS]
    rows = runs.episodes("active_perception", attempt, jobs, options)
    asked = [row for row in rows if row["seed"] in options.seeds]
    publish(
        "active-perception", render(Campaign(asked, options.drives), options.drives), {row["code"] for row in asked}
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
