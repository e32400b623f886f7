"""Plans for several futures of movers: hypotheses and their weights, rows of each tail, and what is driven."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from maps import field, walled
from test_movers import AFAR, DT, RADIUS, clock, seen, walk
from unifg.horizon import Tree
from unifg.scenarios.ground.drive_control import Controller
from unifg.scenarios.ground.drive_parts import predicted
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.futures import REST, futures, horizon_of
from unifg.scenarios.perception.motion_model import MotionModel
from unifg.scenarios.perception.tracks import Tracks
from unifg.typing import Array

TREE = ControllerSettings(futures="tree", tails=3)
ROOM = field(walled(9.0, 2.4, name="corridor"))
POSE = np.array([2.0, 1.0, 0.0])
WAVE = np.array([4.0, 0.4, 4.0, 1.6, 0.3, 0.8])


def movers(*weights: tuple[float, ...]) -> Tracks:
    """Movers that go along y, which may go to and fro."""
    count = len(weights)
    place = np.column_stack([4.0 + np.arange(count), np.full(count, 0.7)])
    found = Tracks.of_movers(place, np.tile([0.0, 0.8], (count, 1)), np.full(count, RADIUS))
    return replace(found, wave=np.tile(WAVE, (count, 1)), weights=np.array([[*row, 0.0][:4] for row in weights]))


# ------------------------------------------------------------------ hypotheses


def test_weights_tell_going_on_from_standing() -> None:
    on, still = MotionModel(), MotionModel()
    for time in clock(0.0, 3.0):
        goes = on.update(seen(np.array([0.8 * time, 1.0]), np.array([0.8, 0.0])), DT, AFAR)
        stands = still.update(seen(np.array([1.0, 1.0]), np.array([0.5, 0.0])), DT, AFAR)
        if time < 0.5:
            assert np.array_equal(goes.weights[0], [0.0, 1.0, 0.0, 0.0]), "nothing is known yet"
    assert goes.weights[0, 1] > 0.98 and stands.weights[0, 2] > 0.98
    assert np.isnan(goes.wave).all()


def test_a_round_trip_is_a_hypothesis_before_it_is_known() -> None:
    """From the second turn on a wave is fitted; its weight grows until the others are unlikely."""
    tracks = walk(MotionModel(), clock(0.3, 6.0), 1.0)
    fitted = [each for each in tracks if np.isfinite(each.wave[0, 5])]
    assert fitted and np.allclose([each.weights[0, :3].sum() for each in tracks], 1.0)
    for each in fitted:
        assert each.sweeps[0] == (each.weights[0, 0] >= 0.98)
        if each.sweeps[0]:
            assert np.array_equal(each.wave, each.sweep)


def test_joint_hypotheses_come_by_their_probability() -> None:
    tracks = movers((0.6, 0.4, 0.0), (0.0, 0.3, 0.7))
    found = futures(TREE, tracks)
    assert found.probabilities == pytest.approx(np.array([0.42, 0.28, 0.30]))
    times = np.array([0.0, 1.0])
    first, second = found.tracks
    assert np.allclose(first.swept(times)[:, 0, 1], [0.7, 1.5]) and np.allclose(first.swept(times)[:, 1, 1], 0.7)
    assert np.allclose(second.swept(times)[1], [[4.0, 1.5], [5.0, 0.7]])
    several = futures(replace(TREE, tails=5), tracks)
    assert len(several.tracks) == 4 and several.probabilities[-1] == pytest.approx(REST / (1.0 + REST))


def test_no_tail_counts_on_a_mover_that_yields() -> None:
    """Its tails, and their clearances, are those of one that does not."""
    found, other = (futures(TREE, movers((0.0, 0.7, 0.3, yields))) for yields in (0.9, 0.0))
    assert np.array_equal(found.probabilities, other.probabilities)
    for tail, same in zip(found.tracks, other.tracks, strict=True):
        assert np.array_equal(tail.sweep, same.sweep)


@pytest.mark.parametrize(
    ("tracks", "count"),
    [
        (Tracks.none(), 0),
        (replace(movers((0.99, 0.01, 0.0)), sweep=WAVE[None]), 0),
        (movers((0.99, 0.005, 0.005)), 1),
        (replace(movers((0.5, 0.5, 0.0)), mover=np.array([False])), 0),
    ],
)
def test_nothing_is_branched_where_nothing_is_open(tracks: Tracks, count: int) -> None:
    """Without movers, for those that are known and discs that never moved; unlikely hypotheses have no tail."""
    found = futures(TREE, tracks)
    assert len(found.tracks) == count and found.probabilities.sum() == pytest.approx(1.0)
    assert np.count_nonzero(found.probabilities) == count + 1


# ------------------------------------------------------------------ plans


def test_settings_of_trees() -> None:
    tree = horizon_of(TREE)
    assert isinstance(tree, Tree) and [len(path) for path in tree.paths] == [31, 31, 31]
    for chain in ({"futures": "likeliest"}, {"futures": "tree", "avoidance": "potential"}):
        assert horizon_of(ControllerSettings(**chain)) == 30  # type: ignore[arg-type]

    assert horizon_of(ControllerSettings(horizon=4)) == 4  # a chain shares no steps


def reference() -> Array:
    return np.column_stack([POSE[0] + ControllerSettings().stations, np.ones(31), np.zeros(31)])


def rows(settings: ControllerSettings, tracks: Tracks) -> tuple[Controller, dict[str, Any]]:
    """Controller and its data by name."""
    controller = Controller(ROOM, "ipm", settings)
    given = controller.given(POSE, reference(), tracks)
    return controller, {
        h.name: np.asarray(v) for h, v in controller.loop.data(controller.loop.now(POSE, given)).items()
    }


def test_each_tail_has_its_future_and_what_is_shared_the_worst() -> None:
    tracks = movers((0.0, 0.7, 0.3))
    (_, worst), (_, likely), (loop, tree) = (
        rows(replace(TREE, futures=kind), tracks) for kind in ("worst", "likeliest", "tree")
    )
    paths = [path[1:] - 1 for path in loop.loop.tree.paths]
    stands = np.tile(tracks.centre[0], (30, 1))
    for name in ("disc centres", "disc clearance"):
        assert np.array_equal(tree[name][paths[2]], worst[name]), "the last tail, and what it shares with the others"
        assert np.array_equal(tree[name][paths[0]][5:], likely[name][5:])
        assert not np.array_equal(tree[name][paths[0]], worst[name])
    assert np.allclose(tree["disc centres"][paths[1]][5:, 0], stands[5:], atol=1e-4)
    assert np.array_equal(tree["wall clearance"][paths[0]], tree["wall clearance"][paths[2]])
    assert loop.loop.probabilities[loop.loop.tree.leaves] == pytest.approx(futures(TREE, tracks).probabilities)
    assert np.allclose(
        predicted(TREE, POSE, futures(TREE, tracks).tracks[0])[:, 0],
        tracks.centre[0] + DT * np.arange(1, 31)[:, None] * [0.0, 0.8],
    )


def test_a_tree_without_movers_plans_as_the_chain_does() -> None:
    plans = []
    for kind in ("worst", "tree"):
        controller = Controller(ROOM, "ipm", replace(TREE, futures=kind, step_tolerance=1e-6))
        plans.append(controller.plan(POSE, reference(), Tracks.none()))
    assert plans[1].source == "solved" and plans[0].states.shape == plans[1].states.shape
    assert plans[1].states == pytest.approx(plans[0].states, abs=2e-3)


def test_a_tree_goes_on_where_the_worst_case_slows_down() -> None:
    """Somebody crosses ahead, and is likely to be gone; shared controls are driven for that."""
    tracks = replace(movers((0.0, 0.97, 0.03)), centre=np.array([[3.0, 1.35]]))
    ends = {}
    for kind in ("worst", "tree"):
        controller = Controller(ROOM, "ipm", replace(TREE, futures=kind))
        for _ in range(3):
            plan = controller.plan(POSE, reference(), tracks)
        assert plan.source == "solved"
        ends[kind] = plan.states[5, 0]
        if kind == "tree":
            assert controller.loop.solution is not None
            tails = [controller.loop.solution[controller.loop.x][path[-1], 0] for path in controller.loop.tree.paths]
            assert tails[0] > tails[2]
    assert ends["tree"] > ends["worst"]
