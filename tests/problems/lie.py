"""Problems on SO(2), SE(2), SO(3), SE(3) and products whose answers are known in closed form."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

import unifg as fg
from problems.graphs import graph_of, graph_with
from unifg.typing import Array, ArrayLike

Built: TypeAlias = tuple[fg.Graph, dict[fg.Family, Array]]

AXES = np.eye(3)
UP = AXES[2]


@dataclass(frozen=True, kw_only=True)
class LieCase:
    """A problem on a manifold with a known answer.

    Attributes:
        name: for reports.
        make: returns graph and guess.
        best: the known minimum; NaN when no point satisfies the constraints.
        others: objective at other KKT points, each verified.
        answer: (count, storage) by family name, where the minimiser is unique.
        qualified, judged, determined: as for :class:`problems.hock_schittkowski.Case`.
    """

    name: str
    make: Callable[[], Built]
    best: float
    others: tuple[float, ...] = ()
    answer: Mapping[str, ArrayLike] = field(default_factory=dict)
    qualified: bool = True
    judged: float = 2e-6
    determined: bool = True

    @property
    def feasible(self) -> bool:
        """True if an answer exists."""
        return not math.isnan(self.best)

    def build(self) -> Built:
        """Graph and guess."""
        return self.make()


def turned(axis: Array, angle: float) -> Array:
    """(1, 4) rotation about an axis."""
    return np.asarray(fg.SO3.exp(angle * np.asarray(axis, dtype=np.float64)[None]))


def posed(position: ArrayLike, axis: Array, angle: float) -> Array:
    """(1, 7) pose."""
    return np.concatenate([np.asarray(position, dtype=np.float64)[None], turned(axis, angle)], axis=1)


def rotated(rotation: Array, vector: ArrayLike) -> Array:
    """(n, 3) one vector turned by n rotations."""
    return np.asarray(fg.SO3.act(rotation, np.broadcast_to(np.asarray(vector, dtype=np.float64), (len(rotation), 3))))


# ------------------------------------------------------------------- attitude

SEEN = fg.SO3.exp(np.array([[0.9, -0.4, 1.3]]))  # the attitude that the sightings below were made from
STARS = np.array([[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [-0.48, 0.64, 0.6], [0.0, 0.0, -1.0]])
WEIGHTS = np.array([2.0, 1.0, 1.5, 0.5])
NOISE = 0.05 * np.array([[1.0, -1.0, 0.5], [0.3, 0.8, -0.6], [-0.7, 0.2, 0.9], [0.4, -0.3, 0.1]])
SIGHTED = np.concatenate([rotated(fg.SO3.inverse(SEEN), star) for star in STARS]) + NOISE
PROFILE = (WEIGHTS[:, None] * STARS).T @ SIGHTED  # Wahba's attitude profile matrix


def davenport() -> tuple[Array, float]:
    """Rotation (1, 4) and cost of Wahba's problem by singular values (Markley 1988)."""
    u, _, v = np.linalg.svd(PROFILE)
    matrix = u @ np.diag([1.0, 1.0, np.linalg.det(u) * np.linalg.det(v)]) @ v
    misfit = STARS - SIGHTED @ matrix.T
    return np.asarray(fg.SO3.from_matrix(matrix))[None], 0.5 * float((WEIGHTS[:, None] * misfit**2).sum())


def wahba() -> Built:
    """Attitude from star sightings, as squares."""
    graph, r = graph_with(fg.SO3, 1, "r")
    stars, sighted = graph.data("stars", STARS, each=True), graph.data("sighted", SIGHTED, each=True)
    graph.minimize(
        lambda x, a, b: a - fg.SO3.act(x, b),
        r,
        stars,
        sighted,
        sigma=np.tile(WEIGHTS[:, None] ** -0.5, (1, 3)),
        name="fit",
    )
    return graph, {r: turned(AXES[0], 2.0)}


def wahba_trace() -> Built:
    """The same as a scalar cost, minus the trace of B'R."""
    graph, r = graph_with(fg.SO3, 1, "r")
    graph.minimize_scalar(lambda x: -np.einsum("ab,nab->n", PROFILE, fg.SO3.to_matrix(x)), r, name="gain")
    return graph, {r: turned(AXES[0], 2.0)}


def brockett() -> Built:
    """Sort the eigenvalues 1, 2, 4 of a symmetric matrix: minimise -tr(N R'AR) with N = diag(1, 2, 3)."""
    graph, r = graph_with(fg.SO3, 1, "r")
    basis = fg.SO3.to_matrix(SEEN)[0]
    symmetric = basis @ np.diag([1.0, 2.0, 4.0]) @ basis.T

    def cost(x: Array) -> Array:
        m = fg.SO3.to_matrix(x)
        return np.asarray(-np.einsum("k,nik,ij,njk->n", np.array([1.0, 2.0, 3.0]), m, symmetric, m))

    graph.minimize_scalar(cost, r, name="order")
    return graph, {r: fg.SO3.retract(SEEN, np.array([[0.5, -0.3, 0.4]]))}


def cone(inside: bool) -> Built:
    """The nearest attitude whose boresight is at most 0.3 rad, or at least 0.9 rad, from the vertical."""
    graph, r = graph_with(fg.SO3, 1, "r")
    graph.minimize(fg.prior, r, turned(TILTED, 0.8 if inside else 0.5)[0], name="wanted")
    limits = {"lower": math.cos(0.3)} if inside else {"upper": math.cos(0.9)}
    graph.constrain(lambda x: rotated(x, UP)[:, 2:], r, **limits, name="cone")
    return graph, {r: turned(np.array([0.0, 1.0, 0.0]), 0.1 if inside else 1.2)}


def levelled() -> Built:
    """The nearest attitude whose x axis is horizontal; the wanted one points 0.7 rad down."""
    graph, r = graph_with(fg.SO3, 1, "r")
    graph.minimize(fg.prior, r, turned(AXES[1], 0.7)[0], name="wanted")
    graph.constrain(lambda x: rotated(x, AXES[0])[:, 2:], r, lower=0.0, upper=0.0, name="level")
    return graph, {r: turned(np.array([0.6, 0.0, 0.8]), 1.0)}


def disjoint_cones() -> Built:
    """A boresight within 0.4 rad of two directions that are 1.2 rad apart: it ends half way between them."""
    graph, r = graph_with(fg.SO3, 1, "r")
    graph.minimize(fg.prior, r, turned(UP, 0.3)[0], sigma=10.0, name="wanted")
    for name, angle in (("first", 0.6), ("second", -0.6)):
        target = rotated(turned(AXES[0], angle), UP)[0]
        graph.constrain(lambda x, t=target: rotated(x, UP) @ t[:, None], r, lower=math.cos(0.4), name=name)
    return graph, {r: turned(AXES[0], 0.5)}


def mean_with_limit() -> Built:
    """Mean of rotations about one axis, limited to 0.5 rad about it."""
    graph, r = graph_with(fg.SO3, 1, "r")
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    measured = graph.data("measured", fg.SO3.exp(np.outer([0.2, 0.9, 1.3], axis)), each=True)
    graph.minimize(fg.prior, r, measured, name="measured")
    graph.constrain(lambda x: fg.SO3.log(x) @ axis[:, None], r, upper=0.5, name="limit")
    return graph, {r: turned(AXES[1], -0.4)}


def slew(steps: int = 6) -> Built:
    """Rest to rest turn of least effort: the rate is constant and about one axis."""
    graph, r, rate = graph_of(("r", fg.SO3, steps + 1), ("rate", fg.Rn(3), steps))
    graph.fix(r[0], turned(UP, 0.0)[0])
    graph.fix(r[-1], turned(np.array([0.0, 0.6, 0.8]), 2.1)[0])
    graph.minimize(fg.prior, rate, np.zeros(3), name="effort")
    graph.constrain(
        lambda a, w, b: fg.SO3.local(fg.SO3.compose(a, fg.SO3.exp(0.5 * w)), b),
        r[:-1], rate, r[1:], lower=0.0, upper=0.0, name="kinematics",
    )  # fmt: skip
    path = fg.SO3.exp(np.linspace(0.0, 2.1, steps + 1)[:, None] * AXES[2])
    return graph, {r: path, rate: np.tile([0.1, 0.1, 0.5], (steps, 1))}


# ------------------------------------------------------------------- angles and the plane


def sector() -> Built:
    """Mean heading of three compasses, one beyond the seam, kept within 0.2 rad of south."""
    graph, h = graph_with(fg.SO2, 1, "h")
    measured = graph.data("measured", np.array([[2.5], [2.7], [-3.1]]), each=True)
    graph.minimize(fg.prior, h, measured, name="compasses")
    graph.constrain(lambda x: -np.cos(x), h, lower=math.cos(0.2), name="sector")
    return graph, {h: np.array([[-2.9]])}


def loop_of_angles(count: int = 5) -> Built:
    """Measured turns that do not add up to a full one, closed by a constraint: the error is shared by variance."""
    graph, h = graph_with(fg.SO2, count, "h")
    sigma = np.linspace(0.1, 0.3, count)[:, None]
    measured = graph.data("measured", np.full((count, 1), 2.0 * np.pi / count + 0.05), each=True)
    turn = graph.variables("turn", fg.Rn(1), count)
    graph.minimize(lambda t, z: t - z, turn, measured, sigma=sigma, name="turns")
    graph.fix(h[0], [0.4])
    following = np.roll(np.arange(count), -1)
    graph.constrain(lambda a, t, b: fg.wrap_angle(b - a - t), h, turn, h[following], lower=0.0, upper=0.0, name="chain")
    return graph, {h: 0.4 + np.linspace(0.0, 5.0, count)[:, None], turn: np.full((count, 1), 1.2)}


def facing_on_rim() -> Built:
    """A pose on a circle of radius 2 that looks at its centre, near a wanted position."""
    graph, x = graph_with(fg.SE2)
    graph.minimize(lambda p: p[:, :2] - np.array([3.0, 4.0]), x, name="near")
    graph.constrain(lambda p: (p[:, :2] ** 2).sum(axis=1, keepdims=True), x, lower=4.0, upper=4.0, name="rim")
    graph.constrain(
        lambda p: np.stack([p[:, 0] * np.sin(p[:, 2]) - p[:, 1] * np.cos(p[:, 2])], axis=1),
        x, lower=0.0, upper=0.0, name="facing",
    )  # fmt: skip
    return graph, {x: np.array([[2.0, 0.5, -2.5]])}


def arm_tip(angles: Array) -> Array:
    """(n, 3) position and heading at the end of three links of length 1, 1 and 0.5, from relative angles (n, 3)."""
    total = np.cumsum(angles, axis=1)
    lengths = np.array([1.0, 1.0, 0.5])
    return np.stack([np.cos(total) @ lengths, np.sin(total) @ lengths, total[:, 2]], axis=1)


def arm_reaching() -> Built:
    """A planar arm whose tip has a pose to take: the wrist's place and the law of cosines give the angles."""
    graph = fg.Graph()
    joints = [graph.variables(name, fg.SO2, 1) for name in ("shoulder", "elbow", "wrist")]
    for joint, angle in zip(joints, (0.5, 0.6, 0.2), strict=True):
        graph.minimize(fg.prior, joint, [angle], name=f"{joint.name} rest")
    wanted = np.array([1.2 + 0.5 * math.cos(1.5), 0.9 + 0.5 * math.sin(1.5), 1.5])

    def misses(a: Array, b: Array, c: Array) -> Array:
        tip = arm_tip(np.concatenate([a, b, c], axis=1)) - wanted
        return np.concatenate([tip[:, :2], fg.wrap_angle(tip[:, 2:])], axis=1)

    graph.constrain(misses, *joints, lower=0.0, upper=0.0, name="tip")
    return graph, {joint: np.array([[angle]]) for joint, angle in zip(joints, (0.2, 0.3, 0.1), strict=True)}


def arm_angles(bend: float) -> Array:
    """(3,) angles that `arm_reaching` may find, the elbow bent one way or the other."""
    elbow = bend * math.acos(0.5 * math.hypot(1.2, 0.9) ** 2 - 1.0)
    shoulder = math.atan2(0.9, 1.2) - 0.5 * elbow
    return np.array([shoulder, elbow, 1.5 - shoulder - elbow])


# ------------------------------------------------------------------- poses in space

CORNERS = np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.5], [-1.0, -1.0, 0.0], [1.0, -1.0, -0.5]])  # mean zero
PLACED = posed([2.0, -1.0, 2.0], np.array([0.0, 0.6, 0.8]), 0.9)
TARGETS = np.asarray(fg.SE3.act(np.repeat(PLACED, 4, axis=0), CORNERS))


def tethered_registration() -> Built:
    """Fit points to points while the origin stays on a sphere of radius 2: rotation as without, position shortened."""
    graph, x = graph_with(fg.SE3)
    corners, targets = graph.data("corners", CORNERS, each=True), graph.data("targets", TARGETS, each=True)
    graph.minimize(lambda p, a, b: fg.SE3.act(p, a) - b, x, corners, targets, name="fit")
    graph.constrain(lambda p: (p[:, :3] ** 2).sum(axis=1, keepdims=True), x, lower=4.0, upper=4.0, name="tether")
    return graph, {x: posed([1.0, 0.0, 0.5], AXES[0], 0.3)}


def screw_chain(count: int = 5) -> Built:
    """Poses along a screw, each step measured a tenth too short, both ends fixed: every step stretches alike."""
    graph, x = graph_with(fg.SE3, count + 1)
    step = SCREW / 1.1
    graph.fix(x[0], fg.SE3.identity())
    graph.fix(x[-1], fg.SE3.exp(count * SCREW))
    graph.minimize(fg.between, x[:-1], x[1:], fg.SE3.exp(step), name="steps")
    truth = fg.SE3.exp(np.arange(count + 1)[:, None] * SCREW)
    rng = np.random.default_rng(5)
    return graph, {x: fg.SE3.retract(truth, 0.2 * rng.standard_normal((count + 1, 6)))}


AXIS = np.array([1.0, 2.0, 2.0]) / 3.0
SCREW = np.concatenate([0.4 * AXIS, 0.3 * AXIS])  # translation along the axis of rotation


def rigid_link() -> Built:
    """Two poses measured 3 m apart that are held 2 m apart by a rigid link: each gives half."""
    graph, x, y = graph_of(("x", fg.SE3, 1), ("y", fg.SE3, 1))
    graph.minimize(fg.prior, x, posed([0.0, 0.0, 0.0], UP, 0.0)[0], name="first")
    graph.minimize(fg.prior, y, posed([3.0, 0.0, 0.0], UP, 0.0)[0], name="second")
    link = posed([2.0, 0.0, 0.0], UP, 0.0)
    graph.constrain(lambda a, b: fg.SE3.local(fg.SE3.compose(a, link), b), x, y, lower=0.0, upper=0.0, name="link")
    return graph, {x: posed([0.2, -0.3, 0.1], AXES[0], 0.4), y: posed([2.5, 0.4, 0.3], AXES[1], -0.5)}


def hand_eye() -> Built:
    """A camera on a hand, A X = X B for three motions without noise: cost zero at the mounting."""
    graph, x = graph_with(fg.SE3)
    motions = fg.SE3.exp(np.array([[0.2, 0.1, 0, 0.8, 0, 0], [0, 0.3, 0.1, 0, 0.9, 0.2], [0.1, 0, 0.2, 0.3, 0, 1.0]]))
    mounting = np.repeat(MOUNTING, 3, axis=0)
    seen = fg.SE3.compose(fg.SE3.inverse(mounting), fg.SE3.compose(motions, mounting))
    hand, eye = graph.data("hand", motions, each=True), graph.data("eye", seen, each=True)
    graph.minimize(
        lambda p, a, b: fg.SE3.local(fg.SE3.compose(a, p), fg.SE3.compose(p, b)), x, hand, eye, name="motions"
    )
    return graph, {x: fg.SE3.identity()[None]}


MOUNTING = posed([0.1, -0.05, 0.2], np.array([0.8, 0.0, 0.6]), 1.1)


def biased_level() -> Built:
    """Attitude and accelerometer bias as one product: the bias saturates, tilt takes the rest.

    Gravity is read 0.3 rad from where the prior has it; the heading about the vertical is held by its prior.
    """
    graph, x = graph_with(fg.Product(r=fg.SO3, b=fg.Rn(1)))
    graph.minimize(fg.prior, x.r, turned(AXES[0], 0.0)[0], name="heading")
    graph.minimize(fg.prior, x.b, [0.4], sigma=0.1, name="bias")
    graph.bound(x.b, lower=-0.2, upper=0.2, name="range")
    graph.constrain(lambda r, b: fg.SO3.log(r)[:, :1] + b - 0.5, x.r, x.b, lower=0.0, upper=0.0, name="reading")
    return graph, {x: np.concatenate([turned(np.array([0.0, 1.0, 0.0]), 0.3), [[0.0]]], axis=1)}


ATTITUDE, MISFIT = davenport()
ANGLES = arm_angles(1.0)
REST = np.array([0.5, 0.6, 0.2])
TILTED = np.array([0.6, 0.8, 0.0])

LIE = [
    LieCase(name="Wahba, squares", make=wahba, best=MISFIT, answer={"r": ATTITUDE}),
    LieCase(
        name="Wahba, trace",
        make=wahba_trace,
        best=-float(np.trace(PROFILE.T @ fg.SO3.to_matrix(ATTITUDE)[0])),
        answer={"r": ATTITUDE},
    ),
    LieCase(name="Brockett's sorting", make=brockett, best=-17.0, answer={"r": SEEN}),
    LieCase(name="attitude in a cone", make=lambda: cone(True), best=0.125, answer={"r": turned(TILTED, 0.3)}),
    LieCase(name="attitude out of a cone", make=lambda: cone(False), best=0.08, answer={"r": turned(TILTED, 0.9)}),
    LieCase(name="level attitude", make=levelled, best=0.245, answer={"r": turned(AXES[0], 0.0)}),
    LieCase(name="two cones apart", make=disjoint_cones, best=math.nan),
    LieCase(
        name="mean rotation, limited",
        make=mean_with_limit,
        best=0.5 * (0.3**2 + 0.4**2 + 0.8**2),
        answer={"r": turned(np.array([2.0, -1.0, 2.0]) / 3.0, 0.5)},
    ),
    LieCase(name="slew of least effort", make=slew, best=0.5 * 6 * (2.1 / 6 / 0.5) ** 2),
    LieCase(
        name="mean heading, limited",
        make=sector,
        best=0.5 * ((math.pi - 2.7) ** 2 + (math.pi - 2.9) ** 2 + (0.2 + math.pi - 3.1) ** 2),
        answer={"h": [[math.pi - 0.2]]},
    ),
    LieCase(
        name="loop of angles", make=loop_of_angles, best=0.5 * 0.25**2 / float((np.linspace(0.1, 0.3, 5) ** 2).sum())
    ),
    LieCase(
        name="pose on a rim, facing in",
        make=facing_on_rim,
        best=4.5,
        answer={"x": [[1.2, 1.6, math.atan2(-1.6, -1.2)]]},
    ),
    LieCase(
        name="planar arm",
        make=arm_reaching,
        best=0.5 * float(((ANGLES - REST) ** 2).sum()),
        others=(0.5 * float(((arm_angles(-1.0) - REST) ** 2).sum()),),
        answer={name: [[angle]] for name, angle in zip(("shoulder", "elbow", "wrist"), ANGLES.tolist(), strict=True)},
    ),
    LieCase(
        name="registration on a tether",
        make=tethered_registration,
        best=0.5 * 4,
        answer={"x": np.concatenate([PLACED[:, :3] * 2.0 / 3.0, PLACED[:, 3:]], axis=1)},
    ),
    LieCase(
        name="stretched screw chain",
        make=screw_chain,
        best=0.5 * 5 * float((SCREW**2).sum()) / 11.0**2,
        answer={"x": fg.SE3.exp(np.arange(6)[:, None] * SCREW)},
    ),
    LieCase(
        name="rigid link",
        make=rigid_link,
        best=0.25,
        answer={"x": posed([0.5, 0.0, 0.0], UP, 0.0), "y": posed([2.5, 0.0, 0.0], UP, 0.0)},
    ),
    LieCase(name="hand and eye", make=hand_eye, best=0.0, answer={"x": MOUNTING}),
    LieCase(
        name="bias at its limit",
        make=biased_level,
        best=0.5 * (0.3**2 + 4.0),
        answer={"x": np.concatenate([turned(AXES[0], 0.3), [[0.2]]], axis=1)},
    ),
]
