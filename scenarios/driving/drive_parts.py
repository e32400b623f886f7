"""What the driving robot's horizon says, part by part (Bazzana et al. 2022, section V)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.models.distance_map import SmoothField
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.horizon.part import Given, Gives, Now, Part
from unifg.scenarios.seeing.tracks import Tracks, nearest
from unifg.typing import Array, BoolArray

FAR_AWAY = 1e3  # [m]; where an unused disc waits


@dataclass(frozen=True)
class DriveNow(Now):
    """What the parts may ask for at a tick.

    Attributes:
        reference: (N + 1, 3) poses along the path, the first beside the robot.
        tracks: discs the robot has seen.
    """

    reference: Array
    tracks: Tracks


def following(s: ControllerSettings) -> Part[DriveNow]:
    """Costs of leaving the reference (eq. 8), the one at its end apart."""

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[DriveNow]:
        path = graph.data("reference", np.zeros((s.horizon - 1, 3)), each=True)
        end = graph.data("end of reference", np.zeros(3))
        graph.minimize(unicycle.tracking, x[1:-1], path, sigma=s.weighted(s.pose_sigma), name="path")
        graph.minimize(unicycle.tracking, x[-1], end, sigma=s.weighted(s.terminal_sigma), name="end of path")
        return lambda now: {path: now.reference[1:-1], end: now.reference[-1]}

    return state


def motion(s: ControllerSettings) -> Part[Now]:
    """Dynamics and limits of the unicycle."""

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[Now]:
        graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], s.dt, lower=0.0, upper=0.0, name="dynamics")
        graph.bound(u, lower=[-limit for limit in s.limits], upper=s.limits, name="limits")
        return lambda now: {}

    return state


def clearance(s: ControllerSettings, field: SmoothField) -> Part[DriveNow]:
    """Clearance from walls and tracked discs: soft margins, and hard limits as far as a robot at rest keeps them."""
    n, m = s.horizon, s.discs

    def state(graph: fg.Graph, x: fg.Family, u: fg.Family) -> Gives[DriveNow]:
        wall_limit = graph.data("wall clearance", np.zeros((n, 1)), each=True)
        disc_limit = graph.data("disc clearance", np.zeros((n, m)), each=True)
        centre = graph.data("disc centres", np.full((n, m, 2), FAR_AWAY), each=True)
        radius, shy_radius = graph.data("disc radii", np.zeros(m)), graph.data("disc radii for the margin", np.zeros(m))
        walls, discs = obstacles.wall_distance(field), obstacles.disc_clearance
        margin, sigma = s.robot_radius + s.margin, s.weighted((s.margin_sigma,))[0]
        graph.minimize(obstacles.shortfall(walls, margin), x[1:], sigma=sigma, name="wall margin")
        shy = obstacles.shortfall(discs, margin)
        graph.minimize(shy, x[1:], centre, shy_radius, sigma=sigma, name="disc margin")
        graph.constrain(walls, x[1:], lower=wall_limit, name="walls")
        graph.constrain(discs, x[1:], centre, radius, lower=disc_limit, name="discs")

        def data(now: DriveNow) -> Given:
            pose, chosen = now.present, nearest(now.tracks, now.present, m)
            k = len(chosen)
            centres, radii, movers = np.full((n, m, 2), FAR_AWAY), np.zeros(m), np.zeros(m, dtype=bool)
            centres[:, :k], radii[:k], movers[:k] = predicted(s, pose, chosen), chosen.radius, chosen.mover
            return {
                wall_limit: wall_limits(s, field, pose),
                disc_limit: disc_limits(s, pose, centres, radii, movers),
                centre: centres,
                radius: radii,
                shy_radius: radii + np.where(movers, s.mover_margin, 0.0),
            }

        return data

    return state


def wall_limits(s: ControllerSettings, field: SmoothField, pose: Array) -> Array:
    """(N, 1) least distances to walls; a robot found nearer may not come nearer still."""
    now = field.distance(pose[None, :2])
    return np.full((s.horizon, 1), min(s.robot_radius + s.wall_clearance, float(now[0])))


def predicted(s: ControllerSettings, pose: Array, tracks: Tracks) -> Array:
    """(N, k, 2) centres along the horizon.

    A mover goes straight on, but not into a robot at rest, for which it waits; and it is not trusted to go
    away, for it may turn round.
    """
    stages = s.dt * np.arange(1, s.horizon + 1)
    centres: Array = tracks.centre + stages[:, None, None] * tracks.expected_velocity(pose[:2])
    gap = np.hypot(*np.moveaxis(centres - pose[:2], 2, 0)) - tracks.radius - s.robot_radius
    blocked = np.maximum.accumulate(gap < s.courtesy, axis=0)
    last = np.maximum((~blocked).sum(axis=0) - 1, 0)  # the stage before the mover has to wait
    return np.where(blocked[:, :, None], centres[last, np.arange(len(tracks))], centres)


def disc_limits(s: ControllerSettings, pose: Array, centres: Array, radii: Array, movers: BoolArray) -> Array:
    """(N, M) least distances to discs, as far as a robot at rest keeps them: resting is always feasible.

    A disc that has ever moved is kept off by what it can travel in the meantime, up to a limit, and is not
    approached by more than a share of the gap each step, as a control barrier function demands.
    """
    stages = np.arange(1, s.horizon + 1)[:, None]
    at_rest = np.hypot(*np.moveaxis(pose[:2] - centres, 2, 0)) - radii
    allowance = np.minimum(s.mover_speed * s.dt * stages, s.mover_allowance)
    least = s.robot_radius + s.disc_clearance + np.where(movers, allowance, 0.0)
    spare = np.where(movers, np.maximum(at_rest[0] - least, 0.0), 0.0)
    # A little nearer is allowed, or a robot beside a disc could not even turn its nose past it; not so to a disc
    # that moves, for one that waits beside a robot at rest goes on as soon as the robot does.
    squeezed = np.minimum(at_rest, np.maximum(at_rest - s.squeeze, s.robot_radius + s.squeeze))
    kept = np.where(movers, at_rest, squeezed)
    limits: Array = np.minimum(least + spare * (1.0 - s.approach) ** stages, kept)
    return limits
