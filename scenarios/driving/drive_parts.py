"""What the driving robot's horizon says, term by term (Bazzana et al. 2022, section V)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Now
from unifg.models import obstacles, unicycle
from unifg.models.barriers import share
from unifg.models.distance_map import SmoothField
from unifg.scenarios.driving.drive_settings import ControllerSettings
from unifg.scenarios.seeing.tracks import Tracks, nearest
from unifg.typing import Array, ArrayLike, BoolArray

FAR_AWAY = 1e3  # [m]; where an unused disc waits


@dataclass(frozen=True)
class Drive:
    """What the terms are given at a tick.

    Attributes:
        wanted: (N, 2) controls that would follow the reference [m/s, rad/s].
        reference: (N + 1, 3) poses along the path, the first beside the robot.
        tracks: discs the robot has seen.
    """

    wanted: Array
    reference: Array
    tracks: Tracks


@dataclass(frozen=True)
class Following:
    """Costs of leaving the reference (eq. 8), the one at its end apart."""

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the costs."""
        s = self.settings
        path = graph.data("reference", np.zeros((s.horizon - 1, 3)), each=True)
        end = graph.data("end of reference", np.zeros(3))
        graph.minimize(unicycle.tracking, x[1:-1], path, sigma=s.weighted(s.pose_sigma), name="path")
        graph.minimize(unicycle.tracking, x[-1], end, sigma=s.weighted(s.terminal_sigma), name="end of path")

    def data(self, now: Now[Drive]) -> Mapping[str, ArrayLike]:
        """The reference."""
        return {"reference": now.given.reference[1:-1], "end of reference": now.given.reference[-1]}


@dataclass(frozen=True)
class Limits:
    """Of the unicycle's velocities."""

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Bound the controls."""
        limits = self.settings.limits
        graph.bound(u, lower=[-limit for limit in limits], upper=limits, name="limits")

    def data(self, now: Now[Drive]) -> Mapping[str, ArrayLike]:
        """None."""
        return {}


@dataclass(frozen=True)
class Clearance:
    """Clearance from walls and tracked discs: soft margins, and hard limits as far as a robot at rest keeps them."""

    settings: ControllerSettings
    field: SmoothField

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add margins and limits."""
        s, n, m = self.settings, self.settings.horizon, self.settings.discs
        wall_limit = graph.data("wall clearance", np.zeros((n, 1)), each=True)
        disc_limit = graph.data("disc clearance", np.zeros((n, m)), each=True)
        centre = graph.data("disc centres", np.full((n, m, 2), FAR_AWAY), each=True)
        radius, shy_radius = graph.data("disc radii", np.zeros(m)), graph.data("disc radii for the margin", np.zeros(m))
        walls, discs = obstacles.wall_distance(self.field), obstacles.disc_clearance
        margin, sigma = s.robot_radius + s.margin, s.weighted((s.margin_sigma,))[0]
        graph.minimize(obstacles.shortfall(walls, margin), x[1:], sigma=sigma, name="wall margin")
        shy = obstacles.shortfall(discs, margin)
        graph.minimize(shy, x[1:], centre, shy_radius, sigma=sigma, name="disc margin")
        graph.constrain(walls, x[1:], lower=wall_limit, name="walls")
        graph.constrain(discs, x[1:], centre, radius, lower=disc_limit, name="discs")

    def data(self, now: Now[Drive]) -> Mapping[str, ArrayLike]:
        """Where the discs will be, and what a robot at rest keeps."""
        s, n, m = self.settings, self.settings.horizon, self.settings.discs
        pose, chosen = now.present, nearest(now.given.tracks, now.present, m)
        k = len(chosen)
        centres, radii, movers = np.full((n, m, 2), FAR_AWAY), np.zeros(m), np.zeros(m, dtype=bool)
        centres[:, :k], radii[:k], movers[:k] = predicted(s, pose, chosen), chosen.radius, chosen.mover
        return {
            "wall clearance": wall_limits(s, self.field, pose),
            "disc clearance": disc_limits(s, pose, centres, radii, movers),
            "disc centres": centres,
            "disc radii": radii,
            "disc radii for the margin": radii + np.where(movers, s.mover_margin, 0.0),
        }


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

    A disc that has ever moved is kept off by what it can travel in the meantime, up to a limit, and what is left of
    the gap is a barrier that may shrink at the rate ``approach`` from now on.
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
    limits: Array = np.minimum(least + spare * share(s.approach, s.dt * stages), kept)
    return limits
