"""Everything that the library ships, compiled before it is needed: ``unifg.warmup()``, ``unifg warmup``.

Compiled functions take the same types in every graph. So each backend, smoother and model is taken through something
small, and whatever it comes to call is then in the cache on disk, for all programs to come.
"""

from __future__ import annotations

import hashlib
import json
import pkgutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from functools import partial
from importlib import import_module
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np

from unifg.atomic_write import write_atomically
from unifg.codegen.cache_folder import cache_folder
from unifg.codegen.compile_counter import Tally, counting
from unifg.codegen.jit import processor
from unifg.codegen.precompiled import archive, versions
from unifg.codegen.threads import cores, threads, use_threads
from unifg.errors import UnifgError
from unifg.factors.autodiff.stated import StatedKernel
from unifg.factors.kernel import Kernel
from unifg.factors.residuals import Residual
from unifg.factors.robust import DCS, Cauchy, GemanMcClure, Huber, TruncatedLeastSquares, Tukey
from unifg.files.g2o import read_g2o, write_g2o
from unifg.lie import SE2, SE3, SE23, SO2, SO3, Product, Rn
from unifg.lie.elementwise import LAYOUTS, STORAGE
from unifg.lie.manifold import LieGroup
from unifg.modeling.factors import between, difference, prior
from unifg.modeling.joint_prior import joint_prior
from unifg.models import obstacles, quadrotor, unicycle
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.models.inertial import InertialMeasurements
from unifg.models.interpolation import cubic
from unifg.models.lidar import endpoint, endpoint_loss
from unifg.models.preintegration import BIAS, ImuNoise, predict, preintegrate
from unifg.models.stamped import StampedMeasurements
from unifg.pose_graphs import Submaps, manhattan, sphere
from unifg.pose_graphs.generate import Simulated
from unifg.pose_graphs.initialise import starts
from unifg.smoothing import FixedLag, Incremental
from unifg.solution.graph import Graph
from unifg.solution.solver import Solver
from unifg.solution.warmup_run import rehearse
from unifg.solvers import SQP, AugmentedLagrangian, GraduatedNonConvexity, InteriorPoint
from unifg.solvers.names import TABLE, backend
from unifg.typing import Array

Job: TypeAlias = tuple[str, Callable[[], object]]
Progress: TypeAlias = Callable[[float, str], object]

GROUPS: tuple[LieGroup, ...] = (SE2, SE3, SE23, SO2, SO3, Rn(1), Rn(2), Rn(3), Product(pose=SE2, velocity=Rn(2)))
LOSSES = (Huber(1.0), Cauchy(1.0), GemanMcClure(1.0), Tukey(1.0), TruncatedLeastSquares(1.0), DCS(1.0))


def perform(
    name: str,
    works: Callable[[], list[Job]],
    progress: Progress | None = None,
    anew: bool = False,
    processes: int = 1,
) -> Tally:
    """Do one job after another, unless all of it has been done before and is still there.

    Args:
        name: of the list of jobs.
        works: titles and functions.
        progress: called with the share that is done, and what comes next.
        anew: do it again.
        processes: that compile at once where nothing came precompiled; more than one only where ``__main__`` can be
            imported without doing anything.

    Returns:
        What was compiled, generated and read.
    """
    folder, present = cache_folder(), _present()
    mark = None if folder is None else folder / f"warm-{name}.json"
    if mark is not None and not anew and _holds(mark, present):
        return Tally()
    with counting() as counted:
        done = works()
        if processes > 1 and not archive().usable:
            _compile_at_once(done, processes, progress)
        for number, (title, job) in enumerate(done):
            if progress is not None:
                progress(number / len(done), title)
            job()
        if progress is not None:
            progress(1.0, "")
    if mark is not None:
        with suppress(OSError):  # a cache that cannot be written is warmed again
            mark.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(mark, json.dumps({"of": present, "files": sorted(set(counted.files))}))
    return counted


def _compile_at_once(done: list[Job], processes: int, progress: Progress | None) -> None:
    """Do all jobs in other processes, so that what they compile is there to be read."""
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        futures = {pool.submit(job): title for title, job in done}
        for number, future in enumerate(as_completed(futures)):
            future.result()
            if progress is not None:
                progress(number / len(done), futures[future])


def _holds(mark: Path, present: str) -> bool:
    """Test whether a mark speaks of the present sources, and all that it speaks of is there."""
    try:
        written = json.loads(mark.read_text(encoding="utf-8"))
        return bool(written["of"] == present) and all(Path(file).exists() for file in written["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return False


def _present() -> str:
    """Digest of all sources by their dates, of the versions and of the processor."""
    digest = hashlib.sha256(repr((*sorted(versions().items()), processor())).encode())
    for package in ("unifg", "unifg.solvers", "unifg.models", "unifg.scenarios"):
        for folder in import_module(package).__path__:
            for path in sorted(Path(folder).rglob("*.py")):
                status = path.stat()
                digest.update(f"{path} {status.st_mtime_ns} {status.st_size}".encode())
    return digest.hexdigest()


def jobs() -> Iterator[Job]:
    """Titles and functions to compile."""
    for solver, mode in _backends():
        yield f"{solver.name} {mode}".strip(), partial(rehearse, solver)
    yield "checks", _check
    for group in GROUPS:
        yield f"group {group.name}", partial(_use, group)
    yield "models", _models
    yield "driving", _drive
    yield "questions to an answer", _question
    yield "inertial", _integrate
    for simulated, name in ((manhattan(60, outliers=0.1), "plane"), (sphere(4, 8, outliers=0.1), "space")):
        yield f"pose graph in {name}", partial(_pose_graph, simulated)
        yield f"smoothing in {name}", partial(_smooth, simulated)
    yield "several threads", _share


def _backends() -> Iterator[tuple[Solver, str]]:
    """Every backend, in every mode that runs other code."""
    for name in TABLE:
        if name != "gnc":
            yield backend(name), ""
    yield SQP(hessian="exact"), "exact"
    yield SQP(qp="graph"), "graph"
    yield SQP(qp="graph", hessian="exact"), "graph, exact"
    yield InteriorPoint(hessian="gauss-newton"), "Gauss-Newton"
    yield AugmentedLagrangian(hessian="gauss-newton"), "Gauss-Newton"
    yield AugmentedLagrangian(schedule="bazzana"), "Bazzana"
    yield backend("kkt", globalization="levenberg-marquardt"), "Levenberg-Marquardt"


def _check() -> None:
    graph = Graph()
    x = graph.variables("x", SE2, 3)
    graph.minimize(prior, x[0], [0.0, 0.0, 0.0], sigma=0.1)
    graph.minimize(between, x[:-1], x[1:], [1.0, 0.0, 0.1], sigma=0.1)
    graph.minimize(joint_prior(SE2, SE2), x[0], x[2], np.zeros(6), sigma=1.0)
    graph.minimize(_decide, x)
    graph.check({x: np.zeros((3, 3))})
    prepared = backend("gn").prepare(graph)
    for k in range(3):  # later answers are verified where a comparison comes out anew
        prepared.solve({x: np.full((3, 3), float(k))})


def _decide(pose: Array) -> Array:
    """A comparison of what is unknown, which answers are asked about."""
    return np.where(pose[:, :1] > 0.5, pose[:, :1], 0.5 * pose[:, :1])


def _use(group: LieGroup) -> None:
    """All methods of a group, for batches and in factors."""
    for name, (given, _) in LAYOUTS.items():
        if not all(isinstance(getattr(group, key, None), int) for key in given):
            continue
        arguments = [group.identity() if key == STORAGE else np.zeros(int(getattr(group, key))) for key in given]
        try:
            getattr(group, name)(*[argument[None] for argument in arguments])
        except (UnifgError, AttributeError, NotImplementedError):  # not every group has every method
            continue
    for residual in (prior, between, difference):
        _compile(residual.on(group))
    if group is SO3:
        SO3.to_rpy(SO3.from_rpy(*np.zeros((3, 1))))


def _models() -> None:
    """Every kernel that a module of models holds."""
    for module in pkgutil.walk_packages(import_module("unifg.models").__path__, "unifg.models."):
        for value in vars(import_module(module.name)).values():
            _compile(value)
    vehicle = quadrotor.Parameters()
    quadrotor.fly(quadrotor.STATE.identity(), quadrotor.hover(vehicle), 0.1, vehicle)


def _compile(found: Any) -> None:
    kernel = found.kernel if isinstance(found, Residual) else found
    if isinstance(kernel, StatedKernel) and any(isinstance(argument, int) for argument in kernel.arguments):
        return  # made for the shapes that it is used with
    if isinstance(kernel, Kernel):
        _ = kernel.address, kernel.second_address


def _drive() -> None:
    """A vehicle past a disc, away from walls, with what it has seen."""
    steps, dt = 6, 0.1
    grid = DistanceMap(np.add.outer(np.arange(40.0), np.zeros(40)), 0.25, (-5.0, -5.0, 0.0))
    walls = obstacles.wall_distance(SmoothField(grid))
    for solver in (InteriorPoint(), SQP(), AugmentedLagrangian()):
        graph = Graph()
        x, u = graph.variables("x", SE2, steps + 1), graph.variables("u", Rn(2), steps)
        graph.minimize(prior, x[0], [0.0, 0.0, 0.0], sigma=0.1, name="start")
        graph.minimize(unicycle.tracking, x[1:], [0.5, 0.1, 0.0], sigma=0.3, name="reference")
        graph.minimize(unicycle.rate, u[:-1], u[1:], sigma=1.0, name="rate")
        graph.minimize(obstacles.shortfall(walls, 0.5), x, sigma=0.2, name="margin")
        graph.minimize(endpoint(grid), x[0], [[0.5, 0.0]], sigma=0.1, robust=endpoint_loss(0.1, 0.1), name="scan")
        graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], dt, lower=0, upper=0, name="motion")
        graph.constrain(obstacles.disc_clearance, x, [[0.3, 0.4]], [0.2], lower=0, name="disc")
        graph.constrain(walls, x, lower=0.1, name="walls")
        graph.bound(u, lower=-1.0, upper=1.0, name="limits")
        start = unicycle.rollout(np.zeros(3), np.full((steps, 2), 0.5), dt)
        solver.prepare(graph).solve_many([{x: start, u: np.full((steps, 2), 0.5)}] * 2)


def _question() -> None:
    """Derivatives of answers by data, with limits that act and with a robust loss, and an answer judged anew."""
    graph = Graph()
    x, u = graph.variables("x", SE2, 5), graph.variables("u", Rn(2), 4)
    here, goal = graph.data("here", np.zeros(3)), graph.data("goal", [0.5, 0.0, 0.0])
    graph.fix(x[0], here)
    graph.minimize(prior, x[1:], goal, sigma=[0.5, 0.5, 1.0], robust=Huber(0.3), name="goal")
    graph.minimize(prior, u, [0.0, 0.0], sigma=1.0, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.1, lower=0, upper=0, name="motion")
    graph.bound(u, lower=-0.5, upper=0.5, name="limits")
    prepared, guess = InteriorPoint(tolerance=1e-9).prepare(graph), {x: np.zeros((5, 3)), u: np.zeros((4, 2))}
    prepared.solve_many([guess] * 2)
    solution = prepared.solve(guess)
    solution.sensitivity(u[0], here)
    solution.gains(x, u)
    solution.verify()
    solution.explain()
    free = Graph()
    y = free.variables("y", SE2, 4)
    measured = free.data("measured", [[1.0, 0.0, 0.1]] * 3)
    free.minimize(prior, y[0], [0.0, 0.0, 0.0], sigma=0.1)
    free.minimize(between, y[:-1], y[1:], measured, sigma=0.1, robust=Huber(1.0))
    backend("lm").prepare(free).solve({y: np.zeros((4, 3))}).sensitivity(y[-1], measured)


def _integrate() -> None:
    """Samples of an IMU, as increments and as measurements between states."""
    times, rates, forces = [0.0, 0.05, 0.1], np.zeros((3, 3)), np.tile([0.0, 0.0, 9.8], (3, 1))
    preintegrate(times[:1], rates[:1], forces[:1], [0.0, 0.1], ImuNoise(), np.zeros(6))
    graph = Graph()
    x, b = graph.variables("x", SE23, 2), graph.variables("bias", BIAS, 2)
    imu, fixes = (
        InertialMeasurements(ImuNoise()),
        StampedMeasurements(_off, 3, capacity=1, sigma=0.1, between=cubic(SE23), name="positions"),
    )
    imu.state(graph, x)
    fixes.state(graph, x)
    graph.minimize(prior, b[0], np.zeros(6), sigma=0.1)
    graph.minimize(prior, x[0], SE23.identity(), sigma=0.1)
    imu.add(times, rates, forces)
    fixes.add([0.04], [[0.0, 0.0, 0.0]])
    start = predict(SE23.identity(), imu.integrated([0.0, 0.1], np.zeros((1, 6))))
    data = imu.at(graph, [0.0, 0.1], np.zeros((1, 6))) | fixes.at(graph, [0.0, 0.1])
    backend("lm").prepare(graph).solve({x: start, b: np.zeros((2, 6))}, data=data).marginals(x)


def _off(state: Array, position: Array) -> Array:
    """Position of a state, less a measured one."""
    return state[:, :3] - position


def _pose_graph(simulated: Simulated) -> None:
    """Batch solvers on poses, with every loss."""
    found = simulated.pose_graph
    for loss in (None, *LOSSES):
        graph, x, guess = found.graph(robust=loss)
        solution = backend("lm", max_iterations=5).solve(graph, guess)
    for residual in ("log", "g2o"):
        graph, x, guess = found.graph(residual=residual)
        for name in ("gn", "lm", "dogleg"):
            solution = backend(name, max_iterations=5).solve(graph, guess)
        solution.marginals(x)
        solution.covariance(x[::7])
        solution.pair_covariances(x[-1], x[:3])
        solution.report()
    graph, x, guess = found.graph(robust=TruncatedLeastSquares(1.0))
    GraduatedNonConvexity().solve(graph, guess)
    with TemporaryDirectory() as folder:
        write_g2o(Path(folder) / "map.g2o", found)
        found = read_g2o(Path(folder) / "map.g2o")
        submaps = Submaps.split(found, folder, 20)
        submaps.optimize(max_iterations=1)
        submaps.covariance(1)
    starts(found)
    found.verdict(effort="full")


def _share() -> None:
    """Compile the parallel parts of a solve, if there are several threads."""
    count = threads()
    if cores() < 2:
        return
    use_threads(2)
    try:
        graph, _, guess = sphere(40, 40, seed=0).pose_graph.graph()
        backend("gn", max_iterations=1).solve(graph, guess)
    finally:
        use_threads(count)


def _smooth(simulated: Simulated) -> None:
    """Both smoothers along the same drive."""
    edges, poses = simulated.pose_graph.edges, simulated.pose_graph.poses
    for smoother in (Incremental(), FixedLag(20, late="drop")):
        group = simulated.pose_graph.group
        x = smoother.variables("x", group)
        for k, pose in enumerate(poses):
            if k == 0:
                smoother.minimize(prior, x[0], pose, sigma=0.1)
            for edge in np.flatnonzero(np.maximum(edges.first, edges.second) == k):
                first, second = int(edges.first[edge]), int(edges.second[edge])
                measured = edges.measured[edge]
                smoother.minimize(between, x[first], x[second], measured, sigma=0.1, robust=Huber(1.0))
            smoother.update({x: pose})
        smoother.covariance(x[-1])
        smoother.estimate(x[-1], best=True)
    revocable = Incremental()
    x = revocable.variables("x", group)
    for k, pose in enumerate(poses[:3]):
        revocable.minimize(prior, x[k], pose, sigma=0.1)
        revocable.update({x: pose})
    revocable.minimize(between, x[0], x[2], group.identity(), sigma=0.1, revocable=3.0)
    revocable.update()
