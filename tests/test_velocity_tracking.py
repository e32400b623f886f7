"""Velocity tracking: the vehicle, the published optimum, every backend, what is drawn and written, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import unifg as fg
from judge import judge
from scenes import check_offline, commands_of, data_of, tracks_of
from unifg.models import vehicle
from unifg.models.vehicle import Vehicle
from unifg.scenarios import command, velocity_tracking
from unifg.scenarios.planning.speed_profile import drive_cycle, read_profile
from unifg.scenarios.scenes import velocity_plot as velocity_tracking_plots
from unifg.scenarios.scenes.velocity_scene import velocity_scene
from unifg.scenarios.velocity_tracking import (
    Drive,
    TrackingSettings,
    metrics,
    run_tracking,
    state_problem,
    table,
)
from unifg.solvers import KKT, AugmentedLagrangian, GaussNewton, names
from unifg.typing import Array

LENGTHS = (50, 100, 200, 385)
COSTS = {  # the paper's J, by length and kind of drag; worked out independently
    False: (34481.995068, 75967.385885, 168678.611533, 345514.797577),
    True: (36170.076602, 79709.258534, 177608.498404, 361318.221800),
}
BOUNDED = {(50, False): 35297.4202, (385, False): 384058.6892, (50, True): 37466.2547, (385, True): 394670.5021}
BOUNDS = (-2000.0, 1500.0)
STEP = 1e-3  # the paper's stop rule


@pytest.fixture
def profile(shared_data: Path) -> Path:
    path = shared_data / "profiles" / "velocity_profile_388.csv"
    if not path.is_file():
        pytest.skip("no profiles/velocity_profile_388.csv among the shared data")
    return path


@cache
def solved(solver: str, length: int = 60, bounded: bool = False) -> Drive:
    """A drive of the shipped cycle."""
    bounds = (-1200.0, 900.0) if bounded else None
    return run_tracking(TrackingSettings(length, solver, force_bounds=bounds))


# ---------------------------------------------------------------- the vehicle


def test_the_residual_is_the_difference_equation() -> None:
    car = Vehicle()
    v, f, slope, dt = np.array([[12.0]]), np.array([[800.0]]), 0.03, 0.5
    resistance = 1537.0 * 9.81 * (np.sin(slope) + car.rolling * np.cos(slope)) + 0.421022 * 144.0
    expected = 12.0 + 0.5 / car.equivalent_mass * (800.0 - resistance)
    found = vehicle.dynamics(car)(v, f, np.array([[0.0]]), dt, slope)
    assert found[0, 0] == pytest.approx(-expected, rel=1e-13)
    assert car.resistance(12.0, slope) == pytest.approx(resistance, rel=1e-13)
    linear = car.linearised()
    assert linear.resistance(12.0) == pytest.approx(1537.0 * 9.81 * car.rolling + 20.0 * 12.0, rel=1e-13)


def test_rollout_satisfies_the_residual(rng: np.random.Generator) -> None:
    car, f, slope = Vehicle(), rng.normal(300.0, 500.0, 20), rng.uniform(-0.05, 0.05, 20)
    v = car.rollout(8.0, f, 0.5, slope)
    residual = vehicle.dynamics(car)(v[:-1, None], f[:, None], v[1:, None], 0.5, slope)
    np.testing.assert_allclose(residual, 0.0, atol=1e-14)


# ---------------------------------------------------------------- the paper's problem


@pytest.mark.data
@pytest.mark.parametrize("linear", [False, True], ids=["quadratic", "linear"])
@pytest.mark.parametrize("solver", names.CONSTRAINED)
def test_costs_of_the_reference(profile: Path, solver: str, linear: bool) -> None:
    for length, cost in zip(LENGTHS, COSTS[linear], strict=True):
        drive = run_tracking(TrackingSettings(length, solver, profile, linear))
        assert drive.succeeded, drive.solution.report()
        assert drive.cost == pytest.approx(cost, rel=1e-6)
        assert drive.cost == pytest.approx(2.0 * drive.solution.cost, rel=1e-15)


@pytest.mark.data
def test_the_solution_of_the_reference(profile: Path, shared_reference: Path) -> None:
    table = np.genfromtxt(shared_reference / "velocity_tracking_N385.csv", delimiter=",", skip_header=1)
    drive = run_tracking(TrackingSettings(385, "kkt", profile, tolerance=1e-8))
    np.testing.assert_allclose(drive.speed, table[:, 1], atol=1e-6)
    np.testing.assert_allclose(drive.force, table[: len(drive.force), 2], atol=1e-4)
    np.testing.assert_allclose(drive.multipliers, table[: len(drive.force), 3], atol=1e-4)


@pytest.mark.data
@pytest.mark.parametrize("length", LENGTHS)
def test_iterations_of_the_paper(profile: Path, length: int) -> None:
    """KKT 3-4, 2 with linear drag; costs alone 2; augmented Lagrangian 11-13, here at most 14."""
    for linear, most in ((False, 4), (True, 2)):
        settings = TrackingSettings(length, profile=profile, linear=linear)
        graph, _, _, guess = state_problem(settings, settings.speeds())
        paper = KKT(full_steps=True, step_tolerance=STEP, tolerance=1e-12).solve(graph, guess)
        assert paper.iterations <= most
        assert KKT().solve(graph, guess, check=True).iterations < most  # our test needs no step to confirm the last
    graph, _, _, guess = state_problem(settings, settings.speeds(), constrained=False)
    free = GaussNewton(line_search=False, step_tolerance=STEP, tolerance=1e-15).solve(graph, guess)
    assert free.iterations <= 2
    settings = TrackingSettings(length, profile=profile)
    graph, _, _, guess = state_problem(settings, settings.speeds())
    literal = AugmentedLagrangian(schedule="bazzana", penalty=1e4, step_tolerance=STEP, tolerance=1e-12)
    for solver in (AugmentedLagrangian(), literal):
        solution = solver.solve(graph, guess)
        assert solution.iterations <= 14
        index = LENGTHS.index(length)
        assert 2.0 * solution.cost == pytest.approx(COSTS[False][index], rel=1e-6)


@pytest.mark.data
@pytest.mark.parametrize(("length", "linear"), BOUNDED)
@pytest.mark.parametrize("solver", ["alm", "sqp", "ipm"])
def test_costs_with_force_bounds(profile: Path, solver: str, length: int, linear: bool) -> None:
    drive = run_tracking(TrackingSettings(length, solver, profile, linear, BOUNDS))
    assert drive.succeeded, drive.solution.report()
    assert drive.cost == pytest.approx(BOUNDED[length, linear], rel=1e-6)
    assert drive.force.min() == pytest.approx(-2000.0, abs=1e-3) or length == 50
    assert metrics(drive)["forces_at_a_bound"] > 0


# ---------------------------------------------------------------- the shipped drive cycle


@pytest.mark.parametrize("solver", names.CONSTRAINED)
def test_every_backend_finds_the_same_drive(solver: str) -> None:
    drive, reference = solved(solver), solved("kkt")
    assert drive.succeeded, drive.solution.report()
    assert drive.cost == pytest.approx(reference.cost, rel=1e-5)
    np.testing.assert_allclose(drive.speed, reference.speed, atol=1e-3)
    driven = Vehicle().rollout(0.0, drive.force, 1.0)
    np.testing.assert_allclose(driven, drive.speed, atol=1e-3)


def test_an_independent_judge_agrees() -> None:
    settings = TrackingSettings(40, force_bounds=(-1200.0, 900.0))
    graph, _, _, guess = state_problem(settings, settings.speeds())
    for name in ("alm", "sqp", "ipm"):
        solution = names.backend(name).solve(graph, guess, check=True)
        assert judge(graph, solution).worst() < 1e-5  # differences of a cost of some 1e5


@pytest.mark.parametrize("multiplier", [0.0, 1.0, 1e3, 1e6])
def test_the_first_multipliers_hardly_matter(multiplier: float) -> None:
    settings = TrackingSettings(60)
    graph, _, _, guess = state_problem(settings, settings.speeds())
    duals = {"dynamics": np.full((60, 1), multiplier)}
    kkt = KKT().solve(graph, guess, duals=duals, check=True)
    assert kkt.iterations == solved("kkt").solution.iterations
    assert AugmentedLagrangian().solve(graph, guess, duals=duals, check=True).iterations <= 14


@pytest.mark.parametrize("limit", [1, 5, 50])
def test_inner_iterations_are_limited(limit: int) -> None:
    settings = TrackingSettings(60)
    graph, _, _, guess = state_problem(settings, settings.speeds())
    solution = AugmentedLagrangian(inner_iterations=limit, penalty=100.0).solve(graph, guess, check=True)
    outer = [int(row.details["outer"]) for row in solution.history[1:]]
    inner = np.bincount(outer)[1:]
    assert 1 <= inner.max() <= limit
    assert inner.sum() == solution.iterations
    assert 2.0 * solution.cost == pytest.approx(solved("kkt").cost, rel=1e-6)


def test_slopes_are_climbed_with_more_force(tmp_path: Path) -> None:
    lines = ["t_s,v_ref_mps,slope_rad", *(f"{0.5 * k},10,{0.05 if k > 10 else 0.0}" for k in range(31))]
    path = tmp_path / "hill.csv"
    path.write_text("\n".join(lines) + "\n")
    drive = run_tracking(TrackingSettings(30, profile=path, start=10.0, effort=1e-7))
    assert drive.succeeded and drive.profile.dt == 0.5
    uphill, level = drive.force[20], drive.force[5]
    assert uphill - level == pytest.approx(1537.0 * 9.81 * np.sin(0.05), rel=0.02)


def test_drive_cycle_is_smooth_starts_at_rest_and_repeats() -> None:
    cycle = drive_cycle(900).speed
    assert cycle.shape == (901,) and cycle[0] == 0.0
    assert cycle.min() >= 0.0 and 25.0 < cycle.max() < 30.0
    assert np.abs(np.diff(cycle)).max() < 1.6 and np.abs(np.diff(cycle, n=2)).max() < 0.5
    np.testing.assert_allclose(cycle[400:500], cycle[12:112], atol=1e-12)
    np.testing.assert_allclose(drive_cycle(50).speed, cycle[:51], atol=1e-14)


# ---------------------------------------------------------------- what is drawn and written


def test_picture_shows_the_drive() -> None:
    drive = solved("ipm", bounded=True)
    figure = velocity_tracking_plots.picture(drive)
    _, error, force, _ = figure.axes

    def data(line: Any) -> Array:
        return np.asarray(line.get_ydata(), dtype=np.float64)

    lines = {str(line.get_label()): data(line) for axes in figure.axes for line in axes.lines}
    np.testing.assert_array_equal(lines["speed of the vehicle"], drive.speed)
    np.testing.assert_array_equal(lines["profile to follow"], drive.profile.speed)
    np.testing.assert_array_equal(lines["force of the vehicle"][:-1], drive.force)
    np.testing.assert_allclose(lines["resistance of air and road"], Vehicle().resistance(drive.speed))
    assert any(np.array_equal(data(line), drive.error) for line in error.lines)
    assert len(lines["violation"]) == len(drive.solution.history) == len(lines["complementarity"])
    assert force.get_ylim()[0] < -1200.0 and force.get_ylim()[1] > 900.0
    assert [text.get_text().strip() for text in force.texts] == ["not allowed"] * 2
    assert "optimum after" in figure.get_suptitle()
    assert "complementarity" not in {
        line.get_label() for line in velocity_tracking_plots.picture(solved("kkt")).axes[3].lines
    }


def test_the_scene_drives_as_far_as_the_speeds_say() -> None:
    drive = solved("kkt")
    page = velocity_scene(drive).html()
    check_offline(page)
    data, tracks = data_of(page), tracks_of(commands_of(page))
    times, places = zip(*tracks["car"][".position"], strict=True)
    steps = np.diff(np.array(places)[:, 0]) / (drive.profile.dt * np.diff(times))
    middle = 0.5 * (drive.speed[:-1] + drive.speed[1:])
    np.testing.assert_allclose(steps[5:20], middle[np.array(times[:-1])][5:20], atol=1e-9)
    assert {plot["name"] for plot in data["plots"]} == {"speed", "profile", "deviation", "force"}
    assert data["views"][0]["follows"] == "car" and data["good"] is True


def run(folder: Path, *words: str) -> int:
    return command.main(["run", "velocity-tracking", *words, "--out", str(folder)])


@pytest.mark.product(1, of="scenes and pictures")
def test_command_writes_its_files(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path, "--length", "60") == 0
    said = capsys.readouterr()
    for name in ("velocity_tracking.png", "metrics.json", "scene.html"):
        assert str(tmp_path / name) in said.out.splitlines()
        largest = 2_000_000 if name.endswith("html") else 250_000  # a scene carries its viewer
        assert 0 < (tmp_path / name).stat().st_size < largest
    assert "cost J (without 1/2)" in said.out and "done in" in said.err and "done in" not in said.out
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert {**found, "solve_ms": 0.0} == {**metrics(solved("kkt")), "solve_ms": 0.0}
    assert (found["solver"], found["length"], found["drag"], found["force_bounds_n"]) == ("kkt", 60, "quadratic", None)


@pytest.mark.usefixtures("undrawn")
def test_command_takes_bounds_that_begin_with_a_minus(tmp_path: Path) -> None:
    assert run(tmp_path, "--length", "60", "--solver", "ipm", "--linear", "--force-bounds", "-1200,900") == 0
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["force_bounds_n"] == [-1200.0, 900.0] and found["drag"] == "linear"
    assert found["within_bounds"] and found["max_force_n"] == pytest.approx(900.0, abs=1e-3)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--force-bounds", "1,-1"], "the first number must be below the second"),
        (["--force-bounds", "1"], "is not LO,HI"),
        (["--length", "0"], "not a whole number of at least 1"),
        (["--profile", "nowhere.csv"], "no such file"),
        (["--solver", "gn"], "invalid choice"),
        (["--tolerance", "0"], "not a positive number"),
        (["--seed", "1"], "unrecognized arguments"),
    ],
)
def test_bad_arguments_exit_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str
) -> None:
    assert run(tmp_path, *words) == 2
    assert message in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_a_solve_that_falls_short_exits_1(tmp_path: Path) -> None:
    assert run(tmp_path, "--length", "60", "--solver", "penalty", "--tolerance", "1e-9") == 1
    assert not json.loads((tmp_path / "metrics.json").read_text())["converged"]
    drive = solved("ipm", bounded=True)
    broken = replace(drive, force=drive.force * 1.01)
    assert not broken.succeeded and "BROKEN" in table(broken)


@pytest.mark.usefixtures("undrawn")
def test_an_interrupt_writes_what_there_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stopped = run_tracking(TrackingSettings(60), progress=lambda row: row.number == 1)
    assert stopped.solution.status is fg.Status.INTERRUPTED
    monkeypatch.setattr(velocity_tracking, "run_tracking", lambda settings, progress: stopped)
    assert run(tmp_path) == command.INTERRUPTED
    assert {file.name for file in tmp_path.iterdir()} == {
        "scene.html",
        "velocity_tracking.png",
        "metrics.json",
    }


def test_wrong_settings_are_refused() -> None:

    with pytest.raises(fg.ScenarioError, match="leave nothing"):
        run_tracking(TrackingSettings(solver="ipm", force_bounds=(1.0, 1.0)))


# ---------------------------------------------------------------- profiles


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no column 'v_ref_mps'"),
        ("k,height\n0,1\n", "no column 'v_ref_mps' of speeds .there are: k, height"),
        ("v_ref_mps\n1\ntwo\n", "3: no finite number in column 'v_ref_mps'"),
        ("t_s,v_ref_mps\n0,1\n1\n", "3: no finite number in column 'v_ref_mps'"),
        ("v_ref_mps\n1\nnan\n", "3: no finite number"),
        ("v_ref_mps\n1\n", "holds 1 speeds"),
        ("t_s,v_ref_mps\n0,1\n1,1\n3,1\n", "4: times must grow by the same step"),
        ("v_ref_mps\n0\n1_5\n", "line 3: no finite number in column 'v_ref_mps'"),
        ("t_ms,v_ref_mps\n0,1\n500,1\n", "1: the column 't_ms' is not read: convert it to 't_s'"),
        ("v_ref_mps,slope_deg\n1,5\n1,5\n", "1: the column 'slope_deg' is not read: convert it to 'slope_rad'"),
        ("t_s,v_ref_mps\n0,1\n0,1\n", "3: times must grow by the same step"),
    ],
)
def test_files_that_are_no_profiles(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "profile.csv"
    path.write_text(text)
    with pytest.raises(fg.FileFormatError, match=message):
        read_profile(path)


def test_profile_without_times_and_with_blank_lines(tmp_path: Path) -> None:
    path = tmp_path / "profile.csv"
    path.write_text("v_ref_mps\n0\n1.5\n\n2\n\n")
    found = read_profile(path)
    np.testing.assert_array_equal(found.speed, [0.0, 1.5, 2.0])
    assert found.dt == 1.0 and found.name == "profile.csv" and not found.slope.any()
    with pytest.raises(fg.ScenarioError, match=r"a drive of 3 steps was asked for, and the profile profile\.csv has 2"):
        run_tracking(TrackingSettings(3, profile=path))
    assert run_tracking(TrackingSettings(1, profile=path)).succeeded
