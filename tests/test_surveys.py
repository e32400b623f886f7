"""Surveys of landmarks that all others contradict: named where they are wrong, and nowhere else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from problems.closures import drive as hills
from problems.closures import slipped
from unifg.files.g2o import write_g2o
from unifg.lie import SE2, SE3
from unifg.pose_graphs import PoseGraph, Sightings, manhattan
from unifg.pose_graphs.surveys import surveys
from unifg.scenarios import command
from unifg.solvers import LevenbergMarquardt
from unifg.typing import Array, IntArray

SIGMA = {"point": [0.1, 0.1], "bearing-range": [0.01, 0.1]}


def drive(seed: int, kind: str = "bearing-range", count: int = 300) -> tuple[PoseGraph, Array]:
    """Odometry through a city without closures, and sightings of 60 landmarks beside the streets; its true poses."""
    rng, city = np.random.default_rng(seed), manhattan(count, seed)
    truth = city.truth
    odometry = replace(city.pose_graph, edges=city.pose_graph.edges[city.pose_graph.edges.odometry])
    marks = truth[rng.integers(0, count, 60), :2] + rng.uniform(-3.0, 3.0, (60, 2))
    local = SE2.act(SE2.inverse(truth)[:, None], marks[None])
    pose, mark = np.nonzero(np.linalg.norm(local, axis=2) < 5.0)
    if kind == "point":
        z = local[pose, mark]
    else:
        z = np.stack([np.arctan2(local[..., 1], local[..., 0]), np.linalg.norm(local, axis=2)], axis=2)[pose, mark]
    z = z + rng.normal(0.0, SIGMA[kind], z.shape)
    weight = np.tile(np.diag(np.array(SIGMA[kind]) ** -2.0), (len(z), 1, 1))
    seen, known = np.unique(mark, return_inverse=True)
    made = replace(
        odometry, poses=truth, landmark_ids=1000 + np.arange(len(seen)), landmarks=marks[seen],
        sightings={kind: Sightings(pose, known, z, weight)},
    )  # fmt: skip
    return made, truth


def solved(pose_graph: PoseGraph) -> PoseGraph:
    graph, x, guess = pose_graph.graph()
    solution = LevenbergMarquardt(tolerance="map").solve(graph, guess)
    return pose_graph.with_poses(solution[x], solution[graph.families["landmarks"]])


def displaced(pose_graph: PoseGraph, chosen: IntArray, motion: Array) -> PoseGraph:
    """The same graph where all landmarks that some poses see were taken for others, a motion away."""
    ((kind, seen),) = pose_graph.sightings.items()
    z, mask = seen.measured.copy(), np.isin(seen.pose, chosen)
    poses = pose_graph.poses[seen.pose[mask]]
    hinge = pose_graph.poses[int(np.median(chosen))]
    across = SE2.compose(SE2.compose(hinge, motion), SE2.inverse(hinge))
    turned = SE2.between(poses, SE2.compose(across, poses))  # of the sensor
    if kind == "point":
        z[mask] = SE2.act(turned, z[mask])
    else:
        points = z[mask, 1:] * np.stack([np.cos(z[mask, 0]), np.sin(z[mask, 0])], axis=1)
        there = SE2.act(turned, points)
        z[mask] = np.stack([np.arctan2(there[:, 1], there[:, 0]), np.linalg.norm(there, axis=1)], axis=1)
    return replace(pose_graph, sightings={kind: replace(seen, measured=z)})


@pytest.mark.product(2)
@pytest.mark.parametrize("kind", ["point", "bearing-range"])
@pytest.mark.parametrize("seed", range(3))
def test_a_survey_that_all_others_contradict_is_named(seed: int, kind: str) -> None:
    made, _ = drive(seed, kind)
    ((_, seen),) = made.sightings.items()
    start = 60 + 40 * seed
    wrong = np.arange(start, start + 20)
    verdict = solved(displaced(made, wrong, np.array([0.8, 0.5, 0.15]))).verdict(effort="cheap")
    (one,) = verdict.of("survey")
    assert one.sightings is not None and one.sightings[0] == kind
    named = seen.pose[one.sightings[1]]
    assert np.isin(named, wrong).all() and {wrong[0], wrong[-1]} == {named.min(), named.max()}
    assert one.stretches[0].tolist() == [wrong[0], wrong[-1]] and not len(one.edges)
    others = np.bincount(seen.landmark[~np.isin(seen.pose, wrong)], minlength=len(made.landmarks))
    assert len(named) >= (np.isin(seen.pose, wrong) & (others[seen.landmark] > 1)).sum()
    assert one.chi2 is not None and one.chi2[0] - one.chi2[1] > 0.5 * one.squared > 50.0
    assert one.moved is not None and one.moved[0] > 0.1 and not verdict.of("slipped")
    assert "all others contradict the survey of landmarks 10" in verdict.sentence()


@pytest.mark.product(1, of="large maps")
@pytest.mark.parametrize("kind", ["point", "bearing-range"])
def test_right_surveys_are_not_named(kind: str) -> None:
    for seed in range(2):
        made, _ = drive(seed, kind)
        right = solved(made)
        assert not right.verdict(effort="cheap").clusters
        seen = made.sightings[kind]
        sure = replace(
            made, edges=replace(made.edges, information=25.0 * made.edges.information),
            sightings={kind: replace(seen, information=25.0 * seen.information)},
        )  # fmt: skip
        assert not solved(sure).verdict(effort="cheap").of("survey")  # all noise is larger than stated


def test_a_slip_or_a_single_sighting_is_not_laid_on_a_survey() -> None:
    made, _ = drive(1)
    verdict = solved(slipped(made, 150, np.array([1.0, 0.5, 0.1]))).verdict(effort="cheap")
    assert not verdict.of("survey") and [150 in one.edges for one in verdict.of("slipped")] == [True]
    seen = made.sightings["bearing-range"]
    z = seen.measured.copy()
    z[200] += [0.4, 2.0]
    single = replace(made, sightings={"bearing-range": replace(seen, measured=z)})
    assert not surveys(solved(single), 1000)[0]


@pytest.mark.product(1, of="large maps")
def test_solving_a_file_names_the_survey(tmp_path: Path) -> None:
    """In words, in numbers, and in the picture, where the survey has no edge to be drawn at."""
    made, _ = drive(0, "point", 150)
    wrong = displaced(made, np.arange(60, 80), np.array([0.8, 0.5, 0.15]))
    write_g2o(tmp_path / "drive.g2o", wrong)
    out = tmp_path / "out"
    options = ["--init", "file", "--effort", "cheap", "--scene", "--out", str(out)]
    assert command.main(["solve", str(tmp_path / "drive.g2o"), *options]) == 0
    (first, *_) = json.loads((out / "metrics.json").read_text())["verdict"]["clusters"]
    assert first["kind"] == "survey" and first["edges"] == [] and first["sightings"][0] == "point"
    assert first["stretches"][0] == [60, 79] and (out / "graph.png").stat().st_size > 10_000


def test_a_survey_in_space() -> None:
    """Points over hills, and a stretch that sees them all elsewhere."""
    rng, made = np.random.default_rng(2), hills(250, 2, spatial=True)
    truth, odometry = made.truth, made.pose_graph.edges.odometry
    marks = truth[rng.integers(0, 250, 60), :3] + rng.uniform(-4.0, 4.0, (60, 3))
    pose, mark = np.nonzero(np.linalg.norm(truth[:, None, :3] - marks, axis=2) < 12.0)
    wrong = (pose >= 90) & (pose < 120)
    across = SE3.exp(np.array([0.8, -0.5, 0.3, 0.02, -0.03, 0.1]))
    there = SE3.compose(SE3.compose(truth[105], across), SE3.inverse(truth[105]))
    z = SE3.act(SE3.inverse(truth[pose]), np.where(wrong[:, None], SE3.act(there, marks[mark]), marks[mark]))
    sightings = Sightings(pose, mark, z + rng.normal(0.0, 0.1, z.shape), np.tile(100.0 * np.eye(3), (len(z), 1, 1)))
    graph = replace(
        made.pose_graph, poses=truth, edges=made.pose_graph.edges[odometry], landmark_ids=np.arange(60),
        landmarks=marks, sightings={"point": sightings},
    )  # fmt: skip
    (one,) = solved(graph).verdict(effort="cheap").of("survey")
    assert one.stretches[0].tolist() == [90, 119] and one.sightings is not None
    assert wrong[one.sightings[1]].all()
