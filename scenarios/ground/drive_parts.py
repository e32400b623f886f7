"""Terms of the ground robot's horizon (Bazzana et al. 2022, section V)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Context, Term, tree_of
from unifg.models import obstacles, unicycle
from unifg.models.barriers import share
from unifg.models.distance_map import SmoothField
from unifg.models.footprint import Body
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.ground.futures import Futures
from unifg.scenarios.perception.tracks import Tracks, nearest
from unifg.scenarios.planning.reference_cost import ReferenceCost
from unifg.typing import Array, ArrayLike, IntArray

FAR_AWAY = 1e3  # [m]; where an unused disc waits
ENDS = "least controls", "greatest controls"


@dataclass(frozen=True)
class EvasiveTrajectory:
    """Trajectory that is driven when no plan is found.

    It keeps limits and accelerations, ends at rest, and keeps clear as far as anything simple does.

    Attributes:
        states: (N + 1, 3) poses from the present on [m, m, rad].
        controls: (N, m) of the base.
        evades: True if it evades a mover before it comes to rest.
    """

    states: Array
    controls: Array
    evades: bool = False


@dataclass(frozen=True)
class Drive:
    """Context of the terms at a tick.

    Attributes:
        wanted: (N, m) controls that would follow the reference.
        reference: (N + 1, 3) poses along the path, the first beside the robot.
        tracks: discs the robot has seen.
        covariance: (3, 3) of the present pose by the past alone, in its tangent space.
        evasive: what is driven when no plan is found.
        futures: of the nearest tracks, that the plan prepares for; None for the worst alone.
    """

    wanted: Array
    reference: Array
    tracks: Tracks
    covariance: Array
    evasive: EvasiveTrajectory
    futures: Futures | None = None


def following(settings: ControllerSettings) -> list[Term]:
    """Costs of leaving the reference (eq. 8), the one at its end apart."""
    pose, end = settings.weighted(settings.pose_sigma), settings.weighted(settings.terminal_sigma)
    tracking = unicycle.tracking
    return [
        ReferenceCost("path", pose, lambda now: now.given.reference[1:-1], ends=False, residual=tracking),
        ReferenceCost("end of path", end, lambda now: now.given.reference[-1], ends=True, residual=tracking),
    ]


@dataclass(frozen=True)
class Motion:
    """The base with controls that change steadily within a step, from those of now on."""

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the dynamics."""
        base, dt = self.settings.kind, self.settings.dt
        now = graph.data("velocities now", np.zeros(base.size))
        graph.constrain(base.ramped, x[0], now, u[0], x[1], dt, lower=0.0, upper=0.0, name="first step")
        tree = tree_of(x)
        motion = x[tree.begins[tree.later]], u[tree.earlier], u[tree.later], x[tree.later + 1], dt
        graph.constrain(base.ramped, *motion, lower=0.0, upper=0.0, name="dynamics")

    def data(self, now: Context[Drive]) -> Mapping[str, ArrayLike]:
        """The control applied last, which has been reached."""
        return {"velocities now": now.last}


@dataclass(frozen=True)
class Limits:
    """Of the controls and of their changes, from those of now to rest after the last step."""

    settings: ControllerSettings

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Bound the controls, and how they change."""
        s = self.settings
        tree = tree_of(x)
        low, high = (
            graph.data(name, np.tile(side, (len(tree), 1)), each=True) for name, side in zip(ENDS, s.box, strict=True)
        )
        graph.bound(u, lower=low, upper=high, name="limits")
        changes = u[tree.earlier], u[tree.later]
        graph.constrain(s.kind.rate, *changes, lower=-s.most, upper=s.most, name="accelerations")

    def data(self, now: Context[Drive]) -> Mapping[str, ArrayLike]:
        """Controls that are reachable in the first step, and from which rest is reachable after the last."""
        s = self.settings
        least, most = s.box
        leaves = np.array([s.horizon]) if now.tree is None else now.tree.leaves
        count = s.horizon if now.tree is None else len(now.tree)
        low, high = np.tile(least, (count, 1)), np.tile(most, (count, 1))
        falls = np.ix_(leaves - 1, np.flatnonzero(s.kind.resting))
        low[falls], high[falls] = np.maximum(low, -s.most)[falls], np.minimum(high, s.most)[falls]
        low[0], high[0] = np.maximum(low[0], now.last - s.most), np.minimum(high[0], now.last + s.most)
        return dict(zip(ENDS, (low, high), strict=True))


@dataclass(frozen=True)
class Clearance:
    """Clearance from walls and tracked discs: soft margins, and hard limits as far as a robot at rest keeps them."""

    settings: ControllerSettings
    field: SmoothField

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add margins and limits."""
        s, n, m = self.settings, len(tree_of(x)), self.settings.discs
        parts = len(s.hull.discs)
        wall_limit = graph.data("wall clearance", np.zeros((n, parts)), each=True)
        disc_limit = graph.data("disc clearance", np.zeros((n, parts * m)), each=True)
        centre = graph.data("disc centres", np.full((n, m, 2), FAR_AWAY), each=True)
        radius, shy_radius = graph.data("disc radii", np.zeros(m)), graph.data("disc radii for the margin", np.zeros(m))
        walls, discs = obstacles.wall_distance(self.field, s.hull), obstacles.clearance_of(s.hull)
        margin, sigma = s.robot_radius + s.margin, s.weighted((s.margin_sigma,))[0]
        graph.minimize(obstacles.shortfall(walls, margin), x[1:], sigma=sigma, name="wall margin")
        shy = obstacles.shortfall(discs, margin)
        graph.minimize(shy, x[1:], centre, shy_radius, sigma=sigma, name="disc margin")
        graph.constrain(walls, x[1:], lower=wall_limit, name="walls")
        graph.constrain(discs, x[1:], centre, radius, lower=disc_limit, name="discs")

    def data(self, now: Context[Drive]) -> Mapping[str, ArrayLike]:
        """Predicted positions of the discs, and the clearance that the evasive trajectory keeps."""
        s, m, tree = self.settings, self.settings.discs, now.tree
        n, stages = (s.horizon, slice(None)) if tree is None else (len(tree), tree.depths[1:] - 1)
        pose, given, chosen = now.present, now.given, nearest(now.given.tracks, now.present, m)
        k, spread = len(chosen), in_world(pose, given.covariance)
        centres, radii, shy = np.full((n, m, 2), FAR_AWAY), np.zeros(m), np.zeros(m)
        shies = (chosen.mover & ~chosen.sweeps) * s.mover_margin
        limits = np.zeros((n, len(s.hull.discs), m))
        radii[:k], shy[:k] = chosen.radius, shies
        for steps, expected in self._tails(now, chosen):
            places = predicted(s, pose, expected)
            centres[steps, :k] = places
            limits[steps, :, :k] = disc_limits(s, pose, places, expected, given.evasive.states, spread)
        return {
            "wall clearance": wall_limits(s, self.field, given.evasive.states, given.reference, spread)[stages],
            "disc clearance": limits.reshape(n, -1),
            "disc centres": centres,
            "disc radii": radii,
            "disc radii for the margin": radii + shy,
        }

    def _tails(self, now: Context[Drive], tracks: Tracks) -> Iterator[tuple[IntArray | slice, Tracks]]:
        """Steps of each tail, from the present on, and what is expected there; the last one is for what may happen."""
        expected = () if now.given.futures is None else now.given.futures.tracks
        if now.tree is None:
            yield slice(None), (*expected, tracks)[0]
            return
        *others, last = (path[1:] - 1 for path in now.tree.paths)
        yield from zip(others, (*expected, *(tracks,) * len(others)), strict=False)
        yield last, tracks


def in_world(pose: Array, covariance: Array) -> Array:
    """(2, 2) covariance of a position [m^2], from that of a pose (3, 3) in its tangent space."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cosine, -sine], [sine, cosine]])
    spread: Array = turn @ covariance[:2, :2] @ turn.T
    return spread


def along(spread: Array, directions: Array) -> Array:
    """(...) standard deviations [m] of a position along directions (..., 2)."""
    length = np.maximum(np.hypot(directions[..., 0], directions[..., 1]), 1e-9)
    variance = np.einsum("...i,ij,...j->...", directions, spread, directions)
    sigma: Array = np.sqrt(np.maximum(variance, 0.0)) / length
    return sigma


def wall_distances(hull: Body, field: SmoothField, states: Array) -> Array:
    """(N, K) distances to walls as their rows count them, of the discs of a body at states (N, 3) [m]."""
    return field.distance(hull.places(states)) + hull.smaller


def disc_distances(hull: Body, states: Array, centres: Array) -> Array:
    """(N, K, M) the same from centres (N, M, 2)."""
    offset = hull.places(states)[:, :, None] - centres[:, None]
    return np.hypot(offset[..., 0], offset[..., 1]) + hull.smaller[:, None]


def wall_limits(s: ControllerSettings, field: SmoothField, evasive: Array, reference: Array, spread: Array) -> Array:
    """(N, K) least distances to walls, as far as the way out keeps them.

    They are wider by what the estimate (2, 2) may be off towards the wall that is nearest along the reference. With
    ``avoidance="barrier"`` what is left of the distance may shrink at the rate ``approach``, too.
    """
    _, slopes = field.distance_and_gradient(reference[1:, :2])
    least = s.robot_radius + s.wall_clearance + s.sigmas * along(spread, slopes)
    if s.avoidance == "barrier":
        spare = np.maximum(float(wall_distances(s.hull, field, evasive[:1]).min()) - least, 0.0)
        least = least + spare * share(s.approach, s.dt * np.arange(1, s.horizon + 1))
    return np.minimum(least[:, None], wall_distances(s.hull, field, evasive[1:]))


def predicted(s: ControllerSettings, pose: Array, tracks: Tracks) -> Array:
    """(N, k, 2) centres along the horizon.

    A mover goes straight on, even through the robot. It is not expected to go away, for it may turn round. One that is
    known to go to and fro does so.
    """
    stages = s.dt * np.arange(1.0, s.horizon + 1.0)
    centres = tracks.centre + stages[:, None, None] * tracks.expected_velocity(pose[:2])
    known = tracks.sweeps
    centres[:, known] = tracks.at(known).swept(stages)
    return centres


def bounds(s: ControllerSettings, tracks: Tracks) -> Array:
    """(m, 4) assumptions on discs for the time ``mover_surprise``: place then, bound of the speed, reach off the place.

    A disc that never moved stays, one that is known to go to and fro goes on so; others may go anywhere within the
    bound [m, m, m/s, m].
    """
    known, place = tracks.sweeps, tracks.centre.copy()
    place[known] = tracks.at(known).swept(np.array([s.mover_surprise]))[0]
    walk = np.where(tracks.mover, np.maximum(np.hypot(*tracks.velocity.T), s.mover_speed), 0.0)
    reach = s.disc_clearance + walk * np.where(known, s.mover_unseen, s.mover_surprise)
    return np.column_stack([place, walk, reach])


def disc_limits(
    s: ControllerSettings, pose: Array, centres: Array, tracks: Tracks, evasive: Array, spread: Array
) -> Array:
    """(N, K, M) least distances to the centres (N, M, 2) of discs less their radii, as far as the way out keeps them.

    They are wider by what the estimate (2, 2) may be off towards a disc. A disc that has ever moved is kept off by what
    it can travel in the meantime, or before it is noticed that it goes elsewhere, and what is left of the gap is a
    barrier that may shrink at the rate ``approach`` from now on; with ``avoidance="barrier"`` that holds for each. Of
    one that is known to go to and fro only what it travels until it is noticed that it does not is kept off, too.
    """
    stages = s.dt * np.arange(1, s.horizon + 1)[:, None]
    kept = disc_distances(s.hull, evasive[1:], centres) - tracks.radius
    movers, known, now = tracks.mover, tracks.sweeps, pose[:2] - tracks.centre
    walk = np.maximum(np.hypot(*tracks.velocity.T), s.mover_speed)
    allowance = np.where(movers, walk * np.minimum(stages, np.where(known, s.mover_unseen, s.mover_surprise)), 0.0)
    least = s.robot_radius + s.disc_clearance + s.sigmas * along(spread, now) + allowance
    guarded = (movers & ~known) | (s.avoidance == "barrier")
    gap = disc_distances(s.hull, pose[None], tracks.centre[None])[0].min(axis=0)
    spare = np.where(guarded, np.maximum(gap - tracks.radius - least, 0.0), 0.0)
    # A little nearer is allowed, or a robot beside a disc could not even turn its nose past it; not so to a disc
    # that moves.
    squeezed = np.minimum(kept, np.maximum(kept - s.squeeze, s.robot_radius + s.squeeze))
    barrier = (least + spare * share(s.approach, stages))[:, None]
    limits: Array = np.minimum(barrier, np.where(movers, kept, squeezed))
    return limits
