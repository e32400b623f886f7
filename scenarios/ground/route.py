"""The global route: Dijkstra on the map, repaired where tracked discs stand in the way."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from unifg.errors import ScenarioError
from unifg.files.ros_map import OccupancyMap
from unifg.models import unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.footprint import Body
from unifg.models.planar import Base
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.follow import PathFollower
from unifg.scenarios.planning.grid import SPACING, Planning, finished, planning
from unifg.scenarios.planning.lattice import plan_poses
from unifg.scenarios.planning.polyline import headed, path_length, resample
from unifg.scenarios.planning.space_time import quickest
from unifg.typing import Array

LOOK_AHEAD = 4.0  # [m] of path checked against tracked discs
REJOIN = 2.0  # [m] beyond the disc where the detour meets the path again
WINDOW = 3.0  # [m] of map kept around the detour's ends
STANDING = 0.15  # [m/s]; faster discs are left to the controller, which predicts them
UNSEEN = ControllerSettings.mover_unseen  # [s] for which a mover may be elsewhere than it is foretold to be
GAP = ControllerSettings.disc_clearance  # [m] between hull and disc that a path must leave
WALL_GAP = ControllerSettings.wall_clearance  # [m] between hull and wall that a path must leave
ALLOWANCE = 0.04  # [m] added to discs when a detour is planned
WIDE = 0.25  # [m] added to discs when the robot is stuck
STUCK_TICKS = 25
STUCK_DISTANCE = 0.1  # [m]
BESIDE = 0.3  # [m] between hulls: a mover as near as this may be waiting for the robot
RETREAT = 1.5  # [m] that a robot goes back to let a mover pass; a path out and back must not fool the follower
CRUMB = 0.1  # [m] between remembered places
NEAR_GOAL = 0.5  # [m] of path left, where turning on the spot is normal
STANDING_GAP = 0.01  # [m] a planned path needs around its start
PATIENCE = 5  # ticks between two repairs
ANYWHERE = 15  # ticks between two searches of the whole map
CLOSED = 60  # ticks for which no way is to be had at all since the goal came nearer, after which there is none
VAIN = 6  # of those ticks that a detour counts which does not lead nearer
STALLED = 400  # ticks without coming nearer to the goal while nothing moves nearby, after which there is no use
WAITING = 2.0  # [m] from the robot within which something that moves may be what it waits for
TICK = 0.1  # [s]
BETWEEN = 10  # ticks between searches for a way between movers
PERIODS = 3.0  # of a mover after which another way is searched
BEYOND = 1.0  # [m] beyond a mover's sweep where a way between movers ends
LONGEST = 12.0  # [s] of such a way
LATE = np.array([-0.2, 0.0, 0.2])  # [s] by which a mover may be late
SMOOTH = 3  # cells on both sides over which a way of cells is averaged
KERNEL = np.full(2 * SMOOTH + 1, 1.0 / (2 * SMOOTH + 1))
EXPANSIONS = 100_000  # of searches in a tick; a longer one goes on in the next
FRESH_STARTS = 3  # ways round about, on each of which the goal may be farther off again


@dataclass(frozen=True)
class Blocked:
    """Why a goal is given up.

    Attributes:
        place: (2,) where the way ends [m].
        clearance: of the robot's centre that no way keeps [m].
        mover: whether something that moves is there.
    """

    place: Array
    clearance: float
    mover: bool = False

    def __str__(self) -> str:
        """For people."""
        x, y = self.place.tolist()
        if self.mover:
            return f"kept away by a mover at ({x:.1f}, {y:.1f})"
        return f"blocked near ({x:.1f}, {y:.1f}), no way of clearance {self.clearance:.2f} m"


class Route:
    """The path to one goal and the robot's progress on it.

    Attributes:
        path: (P, 3) present path [m, m, rad].
        blocked: why there is no use going on; None as long as there may be.
        searched: ticks for which the search of now has gone on; the robot keeps to its path meanwhile.
    """

    def __init__(
        self,
        occupancy: OccupancyMap,
        distance_map: DistanceMap,
        start: Array,
        goal: Array,
        robot_radius: float,
        wall_gap: float = WALL_GAP,
        disc_gap: float = GAP,
        base: Base = unicycle.BASE,
        body: Body | None = None,
    ) -> None:
        """Plan from ``start`` (3,) to ``goal`` (3,), with the clearances that the controller keeps.

        Args:
            occupancy: the map.
            distance_map: of it.
            start: (3,) pose.
            goal: (3,) pose.
            robot_radius: [m].
            wall_gap: between hull and walls that a path must leave [m].
            disc_gap: between hull and discs that a path must leave [m].
            base: that has to follow the path.
            body: of the robot; None for a disc.

        Raises:
            ScenarioError: when there is no way.
        """
        self._occupancy = occupancy
        self._distance_map = distance_map
        self._radius, self._base = robot_radius, base
        self._body = body or Body.disc(robot_radius)
        self._oriented = base.turning_radius > 0.0 or not self._body.round
        self._wall_gap, self._disc_gap = wall_gap, disc_gap
        self.searched = 0
        self._search: Generator[int, None, bool] | None = None
        self.blocked: Blocked | None = None
        self._rest = self._since_anywhere = 0
        self._closed = self._stalled = self._held = 0
        self._nearest, self._starts = np.inf, FRESH_STARTS
        self._trail: list[Array] = []
        self._crumbs: list[Array] = []
        self._follow(finished(self._way(occupancy, distance_map, start, goal)))

    def _way(
        self, occupancy: OccupancyMap, distance_map: DistanceMap, start: Array, goal: Array, discs: Array | None = None
    ) -> Planning:
        """A way (P, 3) on a map, around discs (K, 3); that of a base whose heading matters is found in one part."""
        if self._oriented:
            yield EXPANSIONS
            return plan_poses(
                occupancy, distance_map, start, goal, base=self._base, body=self._body, gap=self._wall_gap,
                extra_discs=discs,
            )  # fmt: skip
        return (yield from planning(
            occupancy, distance_map, start, goal, robot_radius=self._radius,
            clearance_least=self._radius + self._wall_gap, extra_discs=discs,
        ))  # fmt: skip

    def _follow(self, path: Array) -> None:
        self.path = path
        self._follower = PathFollower(path, SPACING if self._oriented else 0.0)
        self._reached = 0.0

    def reference(self, pose: Array, ahead: Array) -> Array:
        """(count, 3) poses along the path, so far ahead (count,) [m] of where the robot at ``pose`` is beside it."""
        poses, self._reached = self._follower.reference(pose, ahead, self._reached)
        return poses

    def repair(self, pose: Array, tracks: Tracks) -> bool:
        """Plan a detour if a standing disc blocks the path ahead, or the robot is stuck.

        A robot that is stuck and finds no wide way nearby goes back the way it came if a mover is beside it, for each
        may be waiting for the other. Otherwise it looks for another way on the whole map, movers left out.

        A search is made in parts: those of a tick are counted, and the robot keeps to its path until all are made.

        Returns:
            Whether the controller should start over from the path: it changed, or the robot is stuck on it.
        """
        if not self._crumbs or np.hypot(*(pose[:2] - self._crumbs[-1])) > CRUMB:
            self._crumbs = [*self._crumbs[-round(RETREAT / CRUMB) :], pose[:2].copy()]
        self._rest, self._since_anywhere = max(self._rest - 1, 0), self._since_anywhere + 1
        self._trail = [*self._trail[-STUCK_TICKS + 1 :], pose[:2].copy()]
        self._look_for_progress(pose, tracks)
        if self._search is None:
            if self._rest:
                return False
            self._search = self._repaired(pose, tracks)
        return self._go_on()

    def _go_on(self) -> bool:
        """Search for as long as a tick allows; the result of :meth:`repair`, False before the search has ended."""
        left, self.searched = EXPANSIONS, self.searched + 1
        assert self._search is not None
        try:
            while left > 0:
                left -= next(self._search)
        except StopIteration as end:
            self._search, self.searched = None, 0
            return bool(end.value)
        return False

    def _repaired(self, pose: Array, tracks: Tracks) -> Generator[int, None, bool]:
        """Work of :meth:`repair`."""
        arc = SPACING * np.arange(len(self.path))
        if self._stuck(float(arc[-1])):
            self._trail = []
            if len(tracks):  # wide around everything, whatever it does just now: the near side has been tried
                rejoin = min(self._reached + 2.0 * REJOIN, float(arc[-1]))
                if (yield from self._detour(pose, rejoin, tracks, WIDE)):
                    pass
                elif self._beside_a_mover(pose, tracks):
                    yield from self._retreat(pose)
                else:
                    still = tracks.at(~tracks.mover)
                    yield from self._detour(pose, float(arc[-1]), still, ALLOWANCE, everywhere=True)
            return True
        standing = tracks.at((np.hypot(*tracks.velocity.T) < STANDING) & ~tracks.sweeps)
        if not len(standing):
            return False
        ahead = (arc >= self._reached) & (arc <= self._reached + LOOK_AHEAD)
        offsets = self._body.places(self.path[ahead])[:, :, None] - standing.centre
        gaps = np.hypot(offsets[..., 0], offsets[..., 1]) + self._body.smaller[:, None]
        room = gaps.min(axis=1) - standing.radius
        blocked = (room < self._radius + self._disc_gap).any(axis=1)
        if not blocked.any():
            return False
        self._rest = PATIENCE
        last = float(arc[ahead][np.flatnonzero(blocked)[-1]])
        staying = ~standing.mover
        closed = (room[:, staying] < self._radius + self._disc_gap).any(axis=1)
        if (yield from self._detour(pose, min(last + REJOIN, float(arc[-1])), standing, ALLOWANCE)):
            if closed.any():  # what has moved and only rests says nothing of whether there is a way
                self._closed += VAIN  # unless the goal comes nearer on it
            return True
        if not closed.any():  # what has moved may go on: where it alone is in the way, the robot waits
            return False
        place = self.path[ahead][np.flatnonzero(closed)[0], :2]
        return (yield from self._round_about(pose, standing.at(staying), place))

    def around(self, pose: Array, tracks: Tracks, speed: float, pause: float) -> bool:
        """Look for a quicker way, called while movers that go to and fro hold the robot; True if found.

        It leads between them, or after three periods of one beside all of them. Where there is none the goal is given
        up.

        Args:
            pose: (3,) of the robot.
            tracks: of discs.
            speed: of the robot [m/s].
            pause: until it has that speed, less what it gets on in the meantime [s].
        """
        sweeping, begin = tracks.at(tracks.sweeps), int(self._reached / SPACING)
        ahead = self.path[begin : begin + round(LOOK_AHEAD / SPACING), :2]
        gap = np.hypot(*np.moveaxis(sweeping.beside(ahead) - ahead[:, None], -1, 0)) - sweeping.radius - self._radius
        met = gap < self._disc_gap + UNSEEN * sweeping.sweep[:, 5]
        if self._oriented or not met.any() or self._search is not None:
            return False
        self._held, self._trail = self._held + 1, []
        if self._held % BETWEEN != 1:
            return False
        first, ends = int(np.argmax(met.any(axis=0))), sweeping.sweep[:, :4].reshape(-1, 2, 2)
        lengths = np.hypot(*(ends[:, 1] - ends[:, 0]).T)
        if self._held * TICK <= PERIODS * 2.0 * lengths[first] / sweeping.sweep[first, 5]:
            last = begin + int(np.flatnonzero(met.any(axis=1))[-1] + BEYOND / SPACING)
            return self._between(pose, tracks, min(last, len(self.path) - 1), speed, pause)
        self._held = 0
        closed = replace(sweeping, centre=ends.mean(axis=1), radius=sweeping.radius + 0.5 * lengths)
        staying = tracks.at(~tracks.mover).followed_by(closed)
        self._search = self._beyond(pose, staying, sweeping.centre[first])
        return self._go_on()

    def _beyond(self, pose: Array, staying: Tracks, place: Array) -> Generator[int, None, bool]:
        """Search a way on the whole map beside all that movers sweep; the goal is given up without one."""
        if (yield from self._detour(pose, float(SPACING * len(self.path)), staying, ALLOWANCE, everywhere=True)):
            return True
        self.blocked = Blocked(place, self._radius + self._wall_gap, mover=True)
        return False

    def _between(self, pose: Array, tracks: Tracks, index: int, speed: float, pause: float) -> bool:
        """Follow the quickest way in place and time to a pose of the path; True if found. Arguments as of `around`."""
        sweeping, more = tracks.at(tracks.sweeps), self._disc_gap - self._wall_gap
        standing = tracks.at((np.hypot(*tracks.velocity.T) < STANDING) & ~tracks.sweeps)

        def discs(time: float) -> Array:
            places = sweeping.swept(time + pause + LATE).reshape(-1, 2)
            radii = np.concatenate([standing.radius, np.tile(sweeping.radius, len(LATE))])
            return np.column_stack([np.concatenate([standing.centre, places]), radii + more])

        window = self._window(np.stack([pose[:2], *self.path[int(self._reached / SPACING) : index + 1, :2]]))
        way = quickest(*window, pose, self.path[index], self._radius + self._wall_gap, discs, speed, LONGEST)
        if way is None:
            return False
        smooth = np.stack([np.convolve(np.pad(x, SMOOTH, mode="edge"), KERNEL, mode="valid") for x in way.T], axis=1)
        points = np.concatenate([pose[None, :2], smooth[1:], self.path[index : index + 1, :2]])
        points = points[np.append(True, np.hypot(*np.diff(points, axis=0).T) > STANDING_GAP)]
        onward = headed(resample(points, SPACING), float(self.path[index, 2]))
        self._follow(np.concatenate([onward[:-1], self.path[index:]]))
        return True

    def _round_about(self, pose: Array, staying: Tracks, place: Array) -> Generator[int, None, bool]:
        """Search another way on the whole map; True if found. After enough failures the goal is given up."""
        self._closed += PATIENCE + 1
        if self._since_anywhere >= ANYWHERE:
            self._since_anywhere = 0
            if (yield from self._detour(pose, float(SPACING * len(self.path)), staying, ALLOWANCE, everywhere=True)):
                return True
        if self._closed > CLOSED:
            self.blocked = Blocked(place.copy(), self._radius + self._wall_gap)
        return False

    def _look_for_progress(self, pose: Array, tracks: Tracks) -> None:
        """Give up a goal that has not come nearer for long, the time left out in which something moved on the way."""
        left = float(SPACING * len(self.path)) - self._reached
        if left < self._nearest - CRUMB:
            self._nearest, self._stalled, self._closed, self._held = left, 0, 0, 0
            return
        self._stalled += not self._waits_for_a_mover(pose, tracks)
        if self._stalled > STALLED:
            if self._starts and left > self._nearest + 2.0 * REJOIN:  # it is on its way round about
                self._starts -= 1
                self._nearest, self._stalled = left, 0
                return
            self.blocked = Blocked(pose[:2].copy(), self._radius + self._wall_gap)

    def _stuck(self, end: float) -> bool:
        """Return True if the robot has hardly moved for a while though the goal is not near."""
        if len(self._trail) < STUCK_TICKS or end - self._reached < NEAR_GOAL:
            return False
        return bool(np.ptp(np.array(self._trail), axis=0).max() < STUCK_DISTANCE)

    def _waits_for_a_mover(self, pose: Array, tracks: Tracks) -> bool:
        """Return True if something that moves now may be what keeps the robot from going on."""
        speed, offset = np.hypot(*tracks.velocity.T), np.hypot(*(tracks.centre - pose[:2]).T)
        return bool(((speed >= STANDING) & (offset - tracks.radius < WAITING)).any())

    def _beside_a_mover(self, pose: Array, tracks: Tracks) -> bool:
        gap = np.hypot(*(tracks.centre - pose[:2]).T) - tracks.radius - self._radius
        return bool((tracks.mover & (gap < BESIDE)).any())

    def _retreat(self, pose: Array) -> Generator[int, None, None]:
        """Go back the way the robot came, and then to the goal again."""
        back = np.stack([pose[:2], *self._crumbs[::-1]])
        if path_length(back) < CRUMB or self._oriented:
            return
        way = headed(resample(back, SPACING), float(pose[2]))
        try:
            onward = yield from self._way(self._occupancy, self._distance_map, back[-1], self.path[-1])
        except ScenarioError:
            return
        self._follow(np.concatenate([way[:-1], onward]))

    def _detour(
        self, pose: Array, rejoin: float, tracks: Tracks, allowance: float, everywhere: bool = False
    ) -> Generator[int, None, bool]:
        """Plan around discs, on the map around the path up to ``rejoin`` [m] or on all of it; True if found."""
        last = len(self.path) - 1
        here, index = min(int(self._reached / SPACING), last), min(round(rejoin / SPACING), last)
        target = self.path[index]
        corners = np.stack([pose[:2], target[:2], *self.path[here : index + 1, :2]])
        # A disc the robot nearly touches is taken as small as leaves it free to go.
        near = self._body.places(pose)[:, None] - tracks.centre
        reach = (np.hypot(near[..., 0], near[..., 1]) + self._body.smaller[:, None]).min(axis=0)
        reach = reach - self._radius - STANDING_GAP
        discs = np.column_stack([tracks.centre, np.clip(reach, 0.0, tracks.radius + allowance)])
        occupancy, distance_map = (self._occupancy, self._distance_map) if everywhere else self._window(corners)
        try:
            detour = yield from self._way(occupancy, distance_map, pose, target, discs)
        except ScenarioError:
            return False  # the controller stops before the disc; the next scan may see a way
        self._follow(np.concatenate([detour[:-1], self.path[index:]]))
        return True

    def _window(self, corners: Array) -> tuple[OccupancyMap, DistanceMap]:
        """The part of the map around some points."""
        cells = self._occupancy.world_to_grid(corners)
        margin = WINDOW / self._occupancy.resolution
        height, width = self._occupancy.shape
        low = np.maximum(np.floor(cells.min(axis=0) - margin), 0).astype(int)
        high = np.minimum(np.ceil(cells.max(axis=0) + margin), [width, height]).astype(int)
        columns, rows = slice(low[0], high[0]), slice(low[1], high[1])
        corner = self._occupancy.grid_to_world(low.astype(np.float64))
        origin = (float(corner[0]), float(corner[1]), self._occupancy.origin[2])
        occupancy = OccupancyMap(
            self._occupancy.occupied[rows, columns],
            self._occupancy.free[rows, columns],
            self._occupancy.resolution,
            origin,
            self._occupancy.name,
        )
        values = self._distance_map.values[rows, columns]
        return occupancy, DistanceMap(values, self._distance_map.resolution, origin)
