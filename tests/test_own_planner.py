"""A planner of the user drives in the controller's place, from a module outside the package."""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from episodes import room
from maps import field, stop_after
from unifg import scenarios
from unifg.errors import ScenarioError
from unifg.files.ros_map import save_map
from unifg.scenarios.command import main
from unifg.scenarios.episode import silent
from unifg.scenarios.flight import Flight, FlightSettings
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.local_planner import PlannerContext, load_planner
from unifg.scenarios.logs.drive_metrics import episode_metrics
from unifg.scenarios.navigation import Episode, NavigationSettings
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.simulation.air import QuadrotorWorld
from unifg.typing import ArrayLike

MODULE = """
import numpy as np
from unifg.scenarios.simulation.plane import World

class Straight:
    def __init__(self, context):
        self.gain, self.limits = 2.0, context.settings.limits

    def control(self, now):
        ahead = now.reference[3, :2] - now.pose[:2]
        turn = self.gain * (np.arctan2(ahead[1], ahead[0]) - now.pose[2])
        return [min(1.0, 2.0 * np.hypot(*ahead)), turn]

class Careful(Straight):
    iterations, forgotten = 7, 0

    def control(self, now):
        return None

    def forget(self):
        self.forgotten += 1

class Wrong(Straight):
    def control(self, now):
        return [1.0, 2.0, 3.0]

class Raising(Straight):
    kind, what, left = KeyError, "lane", 4

    def control(self, now):
        self.left -= 1
        if self.left < 0:
            raise self.kind(self.what)
        return super().control(now)

class Leaving(Raising):
    kind, what = SystemExit, 0

class Telling(Straight):
    answer = None

    def control(self, now):
        return self.answer

class Jammed(World):
    def step(self, *control, dt):
        if self.time > 0.25:
            raise SystemExit(0)
        super().step(*control, dt=dt)

class Mute:
    pass

class Eager:
    def __init__(self):
        pass

    def control(self, now):
        return [0.0, 0.0]

class Wheels:
    def __init__(self, context):
        self.base = context.base
        self.reset(context.pose, context.sigma)

    def reset(self, pose, sigma):
        self.pose, self.covariance = np.array(pose), np.diag(np.square(sigma))

    def update(self, scan, odometry, dt):
        if odometry is not None:
            self.pose = self.base.step(self.pose[None], odometry[None], dt)[0]

class Blank(Wheels):
    def reset(self, pose, sigma):
        self.pose = pose

class Odd(Wheels):
    after = float("inf")
    wrong = {"pose": [0.0, 0.0, 0.0]}

    def update(self, scan, odometry, dt):
        super().update(scan, odometry, dt)
        self.after -= 1
        if self.after < 0:
            vars(self).update(self.wrong)

class Unplugged(World):
    def scan(self):
        raise TimeoutError("no scan came")

class Silent(World):
    def scan(self):
        return super().scan() if self.time < 0.25 else None

class Unsaid(World):
    def odometry(self):
        return [float("nan")] * 2

class Listed(World):
    short = 0

    def odometry(self):
        return [*super().odometry(), *[0.0] * self.short]

    def scan(self):
        scan = super().scan()
        return type(scan)(scan.angles.tolist(), scan.ranges.tolist()[self.short:], scan.time, scan.turn)

class Slow(World):
    def step(self, *control, dt):
        super().step(*(0.5 * part for part in control), dt=dt)

number = 3
"""


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A working directory with a module of planners."""
    (tmp_path / "my_planners.py").write_text(MODULE)
    (tmp_path / "broken_planners.py").write_text("import no_such_package\n")
    save_map(tmp_path / "room.yaml", room())
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_planners", None)


def context() -> PlannerContext:
    return PlannerContext(field(room()), ControllerSettings(accelerations=(1.0, 2.0)), np.random.default_rng(0))


def ahead() -> np.ndarray:
    way = 0.1 * np.arange(ControllerSettings().horizon + 1.0)
    return np.column_stack([way, np.zeros_like(way), np.zeros_like(way)])


@pytest.mark.product(2, of="drives and flights")
def test_a_planner_of_the_working_directory_drives(own: Path) -> None:
    words = ["run", "navigation", "--map", "room.yaml", "--start=0,0,0", "--goal=0.8,0,0", "--obstacles", "0"]
    assert main([*words, "--planner", "my_planners:Straight", "--out", "out"]) == 0
    metrics = json.loads((own / "out" / "metrics.json").read_text())
    assert metrics["solver"] == "my_planners:Straight" and metrics["goals_reached"] == 1
    assert metrics["plan_iterations"]["max"] == 1


def test_what_it_wants_is_brought_within_the_limits(own: Path) -> None:
    plan = load_planner("my_planners:Straight", context()).plan(np.zeros(3), ahead(), Tracks.none())
    assert plan.source == "solved" and plan.control[0] == pytest.approx(0.1)  # 1 m/s^2 for 0.1 s
    assert plan.controls.shape == (30, 2) and plan.states.shape == (31, 3)


def test_without_a_way_the_robot_brakes_and_a_new_route_is_announced(own: Path) -> None:
    adapter = load_planner("my_planners:Careful", context())
    adapter.driven(np.array([0.25, 0.0]))
    plan = adapter.plan(np.zeros(3), ahead(), Tracks.none())
    assert plan.emergency and plan.iterations == 0
    assert np.allclose(plan.controls[:4, 0], [0.15, 0.05, 0.0, 0.0])
    adapter.forget()
    assert getattr(adapter.planner, "forgotten") == 1  # noqa: B009  # the class is not known here


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("teb", "unknown planner 'teb': give 'mpc' or MODULE:CLASS, for example benchmarks.baselines.elastic_band"),
        ("my_planners:", "unknown planner"),
        ("no_such_module:Straight", "cannot import no_such_module from .*: No module named 'no_such_module'"),
        ("broken_planners:Straight", "cannot import broken_planners from .*: No module named 'no_such_package'"),
        ("my_planners:Best", "my_planners has no class Best"),
        ("my_planners:number", "my_planners has no class number"),
        ("my_planners:Mute", r"Mute has no method control\(situation\)"),
        ("my_planners:Eager", r"Eager\(context\) failed: .* takes 1 positional argument"),
    ],
)
def test_a_planner_that_cannot_be_used_is_refused(name: str, why: str, own: Path) -> None:
    with pytest.raises(ScenarioError, match=why):
        load_planner(name, context())


def test_an_answer_of_another_shape_is_refused(own: Path) -> None:
    adapter = load_planner("my_planners:Wrong", context())
    with pytest.raises(ScenarioError, match=r"returned \[1.0, 2.0, 3.0\]: give finite controls"):
        adapter.plan(np.zeros(3), ahead(), Tracks.none())


@pytest.mark.parametrize(
    "answer", ["fast", [1j, 0.0], np.array([1j, 0.0]), [[1.0, 2.0], [3.0]], {"v": 1.0}, [None, 1.0]]
)
def test_an_answer_that_is_no_control_is_named(answer: Any, own: Path) -> None:
    """Dictionaries and complex numbers ended a drive in a TypeError, or lost their imaginary part."""
    adapter = load_planner("my_planners:Telling", context())
    vars(adapter.planner)["answer"] = answer
    with pytest.raises(
        ScenarioError, match=r"the planner returned .*: give finite controls \(2,\) or \(K, 2\), or None"
    ):
        adapter.plan(np.zeros(3), ahead(), Tracks.none())


@pytest.mark.product(2, of="drives and flights")
@pytest.mark.parametrize(("kind", "said"), [("Raising", "KeyError('lane')"), ("Leaving", "SystemExit(0)")])
def test_a_planner_that_raises_is_named_and_recorded(
    own: Path, caplog: pytest.LogCaptureFixture, kind: str, said: str
) -> None:
    """Its ticks were lost, and sys.exit(0) was a success that had written nothing."""
    words = ["run", "navigation", "--map", "room.yaml", "--start=0,0,0", "--goal=3,0,0", "--obstacles", "0"]
    assert main([*words, "--planner", f"my_planners:{kind}", "--out", "out"]) == 1
    metrics = json.loads((own / "out" / "metrics.json").read_text())
    named = f"the planner 'my_planners:{kind}' raised {said}"
    assert metrics["outcomes"] == [f"degraded: the tick failed: {named}"] and metrics["path_length_m"] > 0.0
    assert f"failed, the robot brakes: {named}" in caplog.text and caplog.text.count("raise self.kind(") <= 2


def test_a_localiser_that_raises_is_named_and_recorded(own: Path) -> None:
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),), localiser="my_planners:Odd")
    episode = Episode(settings, rehearsal=True)
    odd = cast(Any, sys.modules["my_planners"]).Odd
    odd.after, odd.wrong = 5, 3  # vars().update(3) is a TypeError
    log = episode.run(stop_after(10))
    assert log.ticks == 10 and "the tick failed: the localiser 'my_planners:Odd' raised TypeError(" in log.cause[-1]


@pytest.mark.product(2, of="drives and flights")
def test_a_world_that_raises_leaves_what_was_recorded(own: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = ["run", "navigation", "--map", "room.yaml", "--start=0,0,0", "--goal=3,0,0", "--obstacles", "0"]
    assert main([*words, "--world", "my_planners:Jammed", "--out", "out"]) == 1
    metrics = json.loads((own / "out" / "metrics.json").read_text())
    assert metrics["outcomes"] == ["ended by SystemExit(0)"] and metrics["steps"] == 4
    assert "navigation was ended before its end" in caplog.text and "in step" in caplog.text
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),), world="my_planners:Jammed")
    with pytest.raises(SystemExit) as raised:
        Episode(settings, rehearsal=True).run(silent)
    assert vars(raised.value)["log"].ticks == 4


@pytest.mark.product(2, of="drives and flights")
def test_an_answer_that_stays_wrong_is_told_once(own: Path, caplog: pytest.LogCaptureFixture) -> None:
    words = ["run", "navigation", "--map", "room.yaml", "--start=0,0,0", "--goal=0.8,0,0", "--obstacles", "0"]
    assert main([*words, "--planner", "my_planners:Wrong", "--out", "out"]) == 1
    said = [record.getMessage() for record in caplog.records]  # while the robot is woken, and when it drives
    assert len(said) <= 2 and all(one.startswith("the tick at 0.00 s failed, the robot brakes: ") for one in said)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"planner": "x:Y", "coupling": "joint"}, "planner 'x:Y' stands for itself: its coupling is 'sequential'"),
        ({"localiser": "amcl", "coupling": "joint"}, "localiser 'amcl' stands for itself"),
        ({"localiser": "best"}, "unknown localiser 'best': give 'graph' or 'amcl' or MODULE:CLASS"),
    ],
)
def test_planner_and_localiser_of_others_have_no_joint_graph(wrong: dict[str, str], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        Episode(NavigationSettings(**wrong))  # type: ignore[arg-type]


def test_a_localiser_and_a_world_of_ones_own_drive(own: Path) -> None:
    plain = NavigationSettings(map=own / "room.yaml", start=(0.0, 0.0, 0.0), goals=((3.0, 0.0, 0.0),))
    episode = Episode(replace(plain, localiser="my_planners:Wheels"), rehearsal=True)
    log = episode.run(stop_after(10))
    np.testing.assert_allclose(log.estimate, log.dead_reckoning, atol=1e-9)
    usual = Episode(plain, rehearsal=True).run(stop_after(10))
    slow = Episode(replace(plain, world="my_planners:Slow"), rehearsal=True).run(stop_after(10))
    assert slow.true_pose[-1, 0] < 0.7 * usual.true_pose[-1, 0]
    module = sys.modules["my_planners"]
    same = Episode(replace(plain, world=module.Slow), rehearsal=True).run(stop_after(10))
    np.testing.assert_array_equal(same.true_pose, slow.true_pose)


@pytest.mark.parametrize(
    "wrong",
    [
        {"pose": np.full(3, np.nan)},
        {"pose": np.zeros((3, 1))},
        {"covariance": np.zeros((3, 3))},
        {"covariance": -np.eye(3)},
        {"covariance": np.full((3, 3), np.nan)},
        {"covariance": np.ones(3)},
        {"covariance": None},
    ],
)
def test_a_localiser_that_says_no_estimate_is_not_believed(wrong: dict[str, Any], own: Path) -> None:
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),), localiser="my_planners:Odd")
    episode = Episode(settings, rehearsal=True)
    odd = cast(Any, sys.modules["my_planners"]).Odd
    odd.after, odd.wrong = 5, wrong
    log = episode.run(stop_after(10))
    assert any("the tick failed: the localiser says pose" in cause for cause in log.cause)
    assert np.isfinite(log.estimate).all() and episode_metrics(log)["nees"]
    odd.after, odd.reset = 5, lambda self, pose, sigma: self.__dict__.update({"pose": pose, "covariance": 0.0} | wrong)
    with pytest.raises(ScenarioError, match=r"give a finite pose \(3,\) and a positive definite covariance"):
        Episode(settings, rehearsal=True)


def test_a_localiser_may_answer_in_lists(own: Path) -> None:
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),), localiser="my_planners:Odd")
    usual = Episode(settings, rehearsal=True).run(stop_after(5))
    odd = cast(Any, sys.modules["my_planners"]).Odd
    odd.reset = lambda self, pose, sigma: self.__dict__.update(kept=pose, covariance=np.diag(np.square(sigma)).tolist())
    odd.pose = property(lambda self: self.kept.tolist())
    odd.update = lambda self, scan, odometry, dt: self.__dict__.update(
        kept=self.kept if odometry is None else self.base.step(self.kept[None], odometry[None], dt)[0]
    )
    np.testing.assert_array_equal(Episode(settings, rehearsal=True).run(stop_after(5)).estimate, usual.estimate)


def test_a_world_that_says_nothing_of_its_wheels_leaves_a_record(own: Path) -> None:
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),), world="my_planners:Unsaid")
    log = Episode(settings, rehearsal=True).run(stop_after(5))
    assert np.isfinite(log.dead_reckoning).all() and log.dropped


def test_a_world_without_a_scan_leaves_a_record(own: Path) -> None:
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),), world="my_planners:Silent")
    log = Episode(settings, rehearsal=True).run(stop_after(5))
    assert np.isfinite(log.scan[:3]).any() and np.isnan(log.scan[3:]).all()
    assert log.dropped == {"lidar: no beam came back (not numbers)": 2}


def test_a_world_may_answer_in_lists_of_the_right_length(own: Path) -> None:
    settings = NavigationSettings(own / "room.yaml", (0.0, 0.0, 0.0), ((3.0, 0.0, 0.0),))
    listed = replace(settings, world="my_planners:Listed")
    usual, same = (Episode(one, rehearsal=True).run(stop_after(5)) for one in (settings, listed))
    np.testing.assert_array_equal(usual.estimate, same.estimate)
    sys.modules["my_planners"].Listed.short = 1
    with pytest.raises(ScenarioError, match=r"the world's scan has shape \(359,\), expected \(360,\)"):
        Episode(listed, rehearsal=True).run(stop_after(5))


def test_an_error_of_a_users_part_is_not_one_of_the_output(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", "navigation", "--map", "room.yaml", "--start=0,0,0", "--goal=0.8,0,0", "--out", "out"]
    assert main([*words, "--world", "my_planners:Unplugged"]) == 2
    assert "error: navigation: TimeoutError: no scan came" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"localiser": "my_planners:Blank"}, "Blank has no covariance"),
        ({"localiser": "my_planners:Straight"}, "has no method update"),
        ({"localiser": "my_planners:Nothing"}, "has no class Nothing"),
        ({"world": "my_planners:Wheels"}, "has no method step"),
        ({"world": "flat"}, "unknown world 'flat'"),
    ],
)
def test_parts_that_lack_something_are_refused_by_name(given: dict[str, str], words: str, own: Path) -> None:
    with pytest.raises(ScenarioError, match=words):
        Episode(replace(NavigationSettings(), **given), rehearsal=True)  # type: ignore[arg-type]


def test_scenarios_list_what_can_be_replaced() -> None:
    assert len(scenarios.__all__) <= 25 and sorted(dir(scenarios)) == sorted(scenarios.__all__)
    for name in scenarios.__all__:
        assert inspect.getdoc(getattr(scenarios, name)), name
    with pytest.raises(AttributeError, match="nothing"):
        _ = scenarios.nothing


def test_a_world_of_flights_that_raises_leaves_what_was_recorded() -> None:
    class Torn(QuadrotorWorld):
        def step(self, control: ArrayLike, dt: float = 0.05) -> None:
            if self.time > 0.2:
                raise RuntimeError("cable")
            super().step(control, dt)

    with pytest.raises(RuntimeError, match="cable") as raised:
        Flight(FlightSettings(world=Torn), rehearsal=True).run(silent)
    log = vars(raised.value)["log"]
    assert log.ticks > 2 and log.outcome == "ended by RuntimeError('cable')" and not log.succeeded
