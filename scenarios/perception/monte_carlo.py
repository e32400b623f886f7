"""An adaptive Monte Carlo localiser (Fox, KLD-sampling, IJRR 22 (2003); Thrun, Burgard, Fox, Probabilistic Robotics).

Whenever the robot has gone far enough, particles are moved by the wheels with sampled noise (table 5.6), weighed by a
likelihood field (table 6.3), and drawn anew, so many that the divergence from the true posterior, on the cells that
they occupy, stays below a limit (table 8.4). Where short-term weights fall behind long-term ones, some are drawn
anywhere on the map (table 8.3).

Numbers are the defaults of ``nav2_amcl``, but for the beams, of which that takes 60 and this all that the other
localiser takes. Its beam skipping is here, too: once the cloud is small, a beam that few particles explain is left out,
unless most beams are like that.

The estimate is the mean of the heaviest cluster of neighbouring cells, as in that package.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from unifg.files.ros_map import OccupancyMap
from unifg.lie import SE2, wrap_angle
from unifg.models import lidar, unicycle
from unifg.models.distance_map import DistanceMap
from unifg.models.planar import Base
from unifg.scenarios.perception.readings import Scan
from unifg.typing import Array, BoolArray, IntArray

__all__ = ["MonteCarlo", "MonteCarloSettings", "needed"]

TURNS = 36  # cells of the heading


@dataclass(frozen=True)
class MonteCarloSettings:
    """Numbers of the localiser.

    Attributes:
        particles: least and greatest number.
        divergence: greatest, between the particles and the posterior, with a probability given by the next.
        quantile: of the normal distribution; 2.33 stands for 0.99.
        cell: sides of the cells that are counted [m], beside 10 degrees.
        noise: alpha 1 to 4: of a turn by turning, by driving, of a way by driving, by turning.
        hit, random: weights of a beam that meets the nearest surface, and of one that meets anything.
        sigma: of the former [m].
        farthest: distance to a surface beyond which it does not matter how far [m].
        moved: motion after which a scan is taken in [m, rad].
        beams: at most so many of a scan, evenly; None for all.
        slow, fast: rates of the two averages of weights; zero draws no particle anywhere.
        skip: whether beams that few particles explain are left out.
        explained: distance to a surface at which a particle explains a beam [m].
        gathered: distance from their mean within which all particles lie before beams are left out [m].
        few: share of the particles that must explain a beam.
        most: share of the beams that may be left out.
    """

    particles: tuple[int, int] = (500, 2000)
    divergence: float = 0.05
    quantile: float = 2.33
    cell: float = 0.5
    noise: tuple[float, float, float, float] = (0.2, 0.2, 0.2, 0.2)
    hit: float = 0.5
    random: float = 0.5
    sigma: float = 0.2
    farthest: float = 2.0
    moved: tuple[float, float] = (0.25, 0.2)
    beams: int | None = None
    slow: float = 0.0
    fast: float = 0.0
    skip: bool = True
    explained: float = 0.5
    gathered: float = 0.5
    few: float = 0.3
    most: float = 0.9


def needed(cells: int, settings: MonteCarloSettings) -> int:
    """Number of particles for a posterior on so many cells (Fox 2003, eq. 7)."""
    least, most = settings.particles
    if cells <= 1:
        return most
    b = 2.0 / (9.0 * (cells - 1))
    count = (cells - 1) / (2.0 * settings.divergence) * (1.0 - b + math.sqrt(b) * settings.quantile) ** 3
    return int(min(max(math.ceil(count), least), most))


class MonteCarlo:
    """A cloud of poses on a map.

    Attributes:
        particles: (M, 3) poses [m, m, rad].
        weights: (M,), which add up to one.
        pose: (3,) mean of the heaviest cluster [m, m, rad].
        covariance: (3, 3) of it, in its tangent space.
        iterations: number of particles at the last update, for the record.
        refused: why the last scan has said nothing, "" where it may have.
    """

    def __init__(
        self,
        occupancy: OccupancyMap,
        distance_map: DistanceMap,
        pose: Array,
        sigma: Array,
        rng: np.random.Generator,
        own: MonteCarloSettings | None = None,
        base: Base = unicycle.BASE,
    ) -> None:
        """Draw the first particles around a pose (3,) with standard deviations (3,) [m, m, rad]."""
        self.own, self._base = own or MonteCarloSettings(), base
        self._rng, self._distances, self._occupancy = rng, distance_map, occupancy
        self._free: IntArray = np.argwhere(occupancy.free & ~occupancy.occupied)
        self.iterations, self.refused = self.own.particles[1], ""
        self._slow = self._fast = 0.0
        self.reset(np.asarray(pose), np.asarray(sigma))

    def everywhere(self) -> None:
        """Know nothing: particles all over the free part of the map."""
        self._begin(self._anywhere(self.own.particles[1]))

    def reset(self, pose: Array, sigma: Array) -> None:
        """Begin anew around a pose (3,), believed with ``sigma`` (3,)."""
        self._begin(pose + sigma * self._rng.standard_normal((self.own.particles[1], 3)))

    def _begin(self, particles: Array) -> None:
        """Begin with particles (M, 3) of one weight."""
        self.particles, self.weights = particles, np.full(len(particles), 1.0 / len(particles))
        self._fresh = True  # nothing has been weighed yet
        self._since: Array = np.zeros(3)  # where the wheels have gone since a scan was taken in
        self._summarise()

    def update(self, scan: Scan | None, odometry: Array | None, dt: float) -> None:
        """Move by odometry (m,) since the last scan, None for none; weigh by a scan once the robot has moved enough."""
        self.refused = "" if scan is not None else "no scan"
        if odometry is not None:
            u = np.asarray(odometry, dtype=np.float64)[None]
            self._since = self._base.step(self._since[None], u, dt)[0]
            scan = None if scan is None else scan.deskewed(self._base.of(u[0]))
        far = np.hypot(*self._since[:2]) >= self.own.moved[0] or abs(self._since[2]) >= self.own.moved[1]
        if scan is None or not (far or self._fresh) or not lidar.usable(scan.ranges).any():
            self.pose = SE2.compose(self._mean[None], self._since[None])[0]
            return
        self._move()
        self._weigh(scan)
        self._draw()
        self._summarise()
        self._since, self._fresh = np.zeros(3), False

    def _move(self) -> None:
        """Sample where each particle went: a turn, a way, a turn, each with noise of its own (table 5.6)."""
        a1, a2, a3, a4 = self.own.noise
        x, y, turn = self._since
        way = float(np.hypot(x, y))
        first = math.atan2(y, x) if way > 0.01 else 0.0  # a robot that turns on the spot has no direction
        second = float(wrap_angle(turn - first))
        bend_1, bend_2 = (min(abs(a), math.pi - abs(a)) for a in (first, second))  # backwards is no turn
        sigma = np.sqrt(
            [
                a1 * bend_1**2 + a2 * way**2,
                a3 * way**2 + a4 * (bend_1**2 + bend_2**2),
                a1 * bend_2**2 + a2 * way**2,
            ]
        )
        drawn = np.array([first, way, second]) - sigma * self._rng.standard_normal((len(self.particles), 3))
        heading = self.particles[:, 2] + drawn[:, 0]
        self.particles = np.column_stack(
            [
                self.particles[:, 0] + drawn[:, 1] * np.cos(heading),
                self.particles[:, 1] + drawn[:, 1] * np.sin(heading),
                wrap_angle(heading + drawn[:, 2]),
            ]
        )

    def _weigh(self, scan: Scan) -> None:
        """Multiply weights by the likelihood of a scan (table 6.3), and note how well it fits."""
        own = self.own
        keep = np.flatnonzero(lidar.usable(scan.ranges))
        if own.beams is not None and len(keep) > own.beams:
            keep = keep[np.linspace(0, len(keep) - 1, own.beams).astype(np.intp)]
        ends = lidar.beam_endpoints(scan.ranges[keep], scan.angles[keep])
        cosine, sine = np.cos(self.particles[:, 2])[:, None], np.sin(self.particles[:, 2])[:, None]
        places = np.stack(
            [
                self.particles[:, :1] + cosine * ends[:, 0] - sine * ends[:, 1],
                self.particles[:, 1:2] + sine * ends[:, 0] + cosine * ends[:, 1],
            ],
            axis=-1,
        )
        distance = np.minimum(np.abs(self._distances.distance(places)), own.farthest)
        counted = self._counted(distance)
        density = own.hit * np.exp(-0.5 * (distance[:, counted] / own.sigma) ** 2) + own.random / lidar.DROP_BEYOND
        log = np.log(density).sum(axis=1)
        # Averages of a product of hundreds of beams would say nothing: those of one beam are taken.
        fit = float(self.weights @ np.exp(log / counted.sum()))
        self._slow += (own.slow if self._slow else 1.0) * (fit - self._slow)
        self._fast += (own.fast if self._fast else 1.0) * (fit - self._fast)
        weights = self.weights * np.exp(log - log.max())
        self.weights = weights / weights.sum()

    def _counted(self, distance: Array) -> BoolArray:
        """(B,) beams that count, of distances (M, B) to the nearest surface."""
        own, everything = self.own, np.ones(distance.shape[1], dtype=bool)
        spread = np.abs(self.particles[:, :2] - self.particles[:, :2].mean(axis=0)).max()
        if not own.skip or spread > own.gathered:
            return everything
        counted = np.mean(distance < own.explained, axis=0) >= own.few
        return counted if (~counted).mean() < own.most else everything

    def _draw(self) -> None:
        """Draw particles anew, as many as the cells they lie on ask for (table 8.4)."""
        own = self.own
        count = own.particles[1]
        chosen = self.particles[self._rng.choice(len(self.particles), count, p=self.weights)]
        lost = max(0.0, 1.0 - self._fast / self._slow) if self._slow else 0.0
        anywhere = self._rng.random(count) < lost
        chosen[anywhere] = self._anywhere(int(anywhere.sum()))
        if lost:  # averages begin anew, as in the package, or it would never be sure again
            self._slow = self._fast = 0.0
        _, first = np.unique(self._cells(chosen), axis=0, return_index=True)
        occupied = np.searchsorted(np.sort(first), np.arange(1, count + 1), side="left")  # among the first n
        enough = np.array([needed(int(k), own) for k in range(len(first) + 1)])[occupied] <= np.arange(1, count + 1)
        kept = max(int(np.argmax(enough)) + 1 if enough.any() else count, own.particles[0])
        self.particles, self.weights, self.iterations = chosen[:kept], np.full(kept, 1.0 / kept), kept

    def _anywhere(self, count: int) -> Array:
        """(count, 3) poses all over the free cells."""
        cells = self._free[self._rng.integers(len(self._free), size=count)][:, ::-1] + self._rng.random((count, 2))
        turn = self._rng.uniform(-math.pi, math.pi, count)
        return np.column_stack([self._occupancy.grid_to_world(cells), turn])

    def _cells(self, poses: Array) -> IntArray:
        """(M, 3) whole numbers of their cells."""
        turn = np.floor((poses[:, 2] + math.pi) / (2.0 * math.pi) * TURNS) % TURNS
        return np.column_stack([np.floor(poses[:, :2] / self.own.cell), turn]).astype(np.intp)

    def _summarise(self) -> None:
        """Mean and covariance of the heaviest cluster of cells that touch."""
        cells, member = np.unique(self._cells(self.particles), axis=0, return_inverse=True)
        places = (cells - cells.min(axis=0)).astype(np.float64)
        places[:, 2] = cells[:, 2]
        sides = [*(places[:, :2].max(axis=0) + 10.0), float(TURNS)]
        pairs = cKDTree(places, boxsize=sides).query_pairs(1.5, p=np.inf, output_type="ndarray")
        links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2)
        _, cluster = connected_components(links, directed=False)
        of_particle = cluster[member.ravel()]
        heaviest = int(np.argmax(np.bincount(of_particle, weights=self.weights)))
        inside = of_particle == heaviest
        weights = self.weights[inside] / self.weights[inside].sum()
        poses = self.particles[inside]
        heading = math.atan2(float(weights @ np.sin(poses[:, 2])), float(weights @ np.cos(poses[:, 2])))
        self.pose = self._mean = np.array([*(weights @ poses[:, :2]), heading])
        apart = SE2.local(np.tile(self._mean, (len(poses), 1)), poses)
        self.covariance: Array = (weights[:, None] * apart).T @ apart + 1e-8 * np.eye(3)
