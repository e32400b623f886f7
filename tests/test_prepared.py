"""After prepare() nothing is compiled or read from the cache: not while solves fail, not in a whole drive."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

import unifg as fg
from problems.graphs import drawn_to, graph_with
from scripts import run_script
from unifg.solvers import GaussNewton, InteriorPoint

# In a process of its own: in this one, other tests have long compiled everything.
SOLVES = """
import json, sys
from dataclasses import replace
import numpy as np
import unifg as fg
from unifg.models import obstacles, unicycle
from unifg.codegen.compile_counter import counting
from unifg.solvers.names import CONSTRAINED, backend

def problem(gap):
    graph = fg.Graph()
    x, u = graph.variables("x", fg.SE2, 9), graph.variables("u", fg.Rn(2), 8)
    graph.minimize(fg.prior, x[-1], [2.0, 0.3, 0.0], sigma=0.1, name="goal", robust=fg.Huber(1.0))
    graph.minimize(fg.prior, u, [0.0, 0.0], sigma=2.0, name="effort")
    graph.constrain(unicycle.dynamics, x[:-1], u, x[1:], 0.3, lower=0, upper=0, name="motion")
    graph.constrain(obstacles.disc_clearance, x[1:], [[1.0, 0.1]], [0.3], lower=0, name="disc")
    graph.constrain(fg.prior, x[0], [0.0, 0.0, 0.0], lower=0, upper=0, name="start")
    graph.bound(u, lower=-1, upper=1, name="limits")
    if gap:
        graph.constrain(fg.prior, x[4], [9.0, 0.0, 0.0], lower=0, upper=0, name="too far")
    return graph, {x: np.linspace([0, 0, 0], [2, 0.3, 0], 9), u: np.zeros((8, 2))}

found = {}
for name in CONSTRAINED:
    prepared = [(backend(name).prepare(graph), guess) for graph, guess in map(problem, (False, True))]
    short = replace(backend(name), max_iterations=1).prepare(prepared[0][0].program.graph)
    statuses = []
    with counting() as new:
        for run, guess in [*prepared, (short, prepared[0][1])]:
            solution = run.solve(guess)
            statuses.append(solution.status.name)
            statuses.append(run.solve(solution.shifted(*guess)).status.name)
    found[name] = [statuses, new.compiled, new.generated, new.read]
print(json.dumps(found))
"""

EPISODE = """
import json, sys
from dataclasses import replace
from unifg.codegen.compile_counter import counting
from unifg.scenarios import flight, navigation
from unifg.scenarios.simulation.faults import Fault

ticks = 0
def progress(done, text):
    global ticks
    ticks += 1
    if ticks == 8:  # from now on solves end early
        loop = run.pilot.controller.loop
        for prepared in (loop.warm, loop.cold):
            prepared.solver = replace(prepared.solver, max_iterations=1)
        run.pilot.controller.settings = replace(run.pilot.controller.settings, feasible=1e-9)
    if ticks == 16:
        raise KeyboardInterrupt

coupling = sys.argv[2]
if sys.argv[1] == "drive":
    run = navigation.Episode(navigation.NavigationSettings(obstacles=2, coupling=coupling))
else:
    dt = flight.FlightSettings().controller.dt  # with a watch that slows, lands and hovers
    faults = Fault("detector-false", 2 * dt), Fault("detector-lost", 4 * dt), Fault("solver-timeout", 13 * dt)
    run = flight.Flight(flight.FlightSettings(movers=1, coupling=coupling, faults=faults))
with counting() as new:
    log = run.run(progress)
print(json.dumps([int(log.emergency.sum()), log.compiled.tolist(), new.compiled, new.generated, new.read]))
"""


# What a tick may turn to, one after the other, on maps as others hand them in: one of them locked, and a wide one.
TURNS = """
import json
from dataclasses import replace
import numpy as np
from unifg.codegen.compile_counter import counting
from unifg.scenarios import navigation
from unifg.scenarios.perception.tracks import Tracks
from unifg.scenarios.planning.grid import finished
from unifg.scenarios.simulation.faults import Fault

def discs(place, velocity, mover):
    found = Tracks.of_movers(place[None, :2], np.array([velocity]), np.array([0.2]))
    return replace(found, mover=np.array([mover]))

def progress(done, text):
    global ticks
    if text == "done":
        return
    ticks += 1
    pilot, route = run.pilot, run.legs[0]
    if ticks == 3:  # something stands on the path: round it, nearby and on the whole map
        ahead = route.path[60]
        stands = discs(ahead, (0.0, 0.0), False)
        turns.append(any(route.repair(pilot.pose, stands) for _ in range(5)))
        turns.append(finished(route._detour(pilot.pose, 1e9, stands, 0.04, everywhere=True)))
    if ticks == 5:  # something comes from the front
        heading = np.array([np.cos(pilot.pose[2]), np.sin(pilot.pose[2])])
        near = pilot.pose[:2] + 0.7 * heading
        turns.append(pilot.controller._evasion_from(pilot.pose, discs(near, tuple(-0.6 * heading), True)).evades)
    if ticks == 7:  # something is right before the hull
        near = replace(run.world.scan(), ranges=np.full(len(run.world.scan().ranges), 0.2))
        ahead = np.array([0.5, 0.0])  # at this moment the robot may be on its way back
        turns.append(bool(pilot.emergency_stop.control(ahead, ahead, near)[0] < ahead[0]))
    if ticks == 9:  # the way it came, to let a mover pass
        finished(route._retreat(pilot.pose))
    if pilot.relocated:
        relocated.append(ticks)
    if ticks == 300 or relocated and ticks > relocated[0] + 5:
        raise KeyboardInterrupt

ticks, turns, relocated = 0, [], []
settings = navigation.NavigationSettings(faults=(Fault("kidnapped", 1.0),))
run = navigation.Episode(settings)
for mask in (run.occupancy.free, run.occupancy.occupied):
    mask.setflags(write=False)
with counting() as new:
    log = run.run(progress)
print(json.dumps([turns, relocated, int(log.compiled.sum()), new.compiled, new.generated, new.read]))
"""


class Particular(GaussNewton):
    """A backend of one's own that takes nothing but the graph it was made for."""

    def iterate(self, run: Any, workspace: Any) -> Any:
        """Refuse graphs of several variables."""
        if run.program.size > 1:
            raise ValueError("one variable, please")
        return super().iterate(run, workspace)


def test_a_rehearsal_that_fails_fails_nothing() -> None:
    graph, x = drawn_to([2.0], sigma=1.0)
    solution = Particular().prepare(graph).solve({x: [[0.0]]})
    assert solution.converged and solution[x][0, 0] == pytest.approx(2.0)


def said(source: str, *words: str) -> object:
    """Last line that a script prints, decoded from JSON."""
    return json.loads(run_script(source, *words).stdout.splitlines()[-1])


@pytest.mark.product(2, of="processes of their own")
def test_no_backend_compiles_after_prepare_however_its_solves_end() -> None:
    found = said(SOLVES)
    assert isinstance(found, dict) and len(found) >= 4
    for name, (statuses, *new) in found.items():
        assert new == [[], [], []], (name, new)
        assert "CONVERGED" in statuses and "ITERATION_LIMIT" in statuses, name
        assert "LOCALLY_INFEASIBLE" in statuses or name == "penalty", (name, statuses)


@pytest.mark.parametrize(("what", "coupling"), [("drive", "sequential"), ("drive", "joint"), ("flight", "joint")])
@pytest.mark.product(1, of="episodes that are prepared")
def test_no_tick_compiles_though_solves_fail(what: str, coupling: str) -> None:
    found = said(EPISODE, what, coupling)
    assert isinstance(found, list)
    emergencies, columns, *new = found
    assert emergencies >= 2
    assert new == [[], [], []] and columns == [0] * 16


@pytest.mark.product(2, of="processes of their own")
def test_no_tick_compiles_whatever_it_turns_to() -> None:
    """A route repaired nearby and on the whole map, a step aside, the last stop, a way back, a robot found again."""
    found = said(TURNS)
    assert isinstance(found, list)
    turned, relocated, columns, *new = found
    assert turned == [True] * 4 and relocated
    assert new == [[], [], []] and columns == 0


def test_slacks_of_a_stored_guess_begin_at_what_its_limits_are_violated_by() -> None:
    graph, x = drawn_to([2.0])
    graph.constrain(lambda x: x, x, upper=1.0, soft=1e-3, name="soft")
    run = InteriorPoint().prepare(graph)
    moved = run.solve({x: [[0.0]]}, check=True).shifted(x, by=0)
    stored = moved.flat(run.program)
    assert stored is not None
    stored[0][:] = 5.0  # the slack among them
    slack = run.program.soft["soft"].family
    assert run.program.columns.view(run.read(moved)[0])[slack][0, 0] == pytest.approx(4.0)


def test_what_a_function_captures_reaches_a_solve_from_a_stored_guess() -> None:
    goal = np.array([2.0])
    graph, x = graph_with(fg.Rn(1))
    graph.minimize(lambda x: x - goal, x)
    graph.bound(x, upper=10.0)
    run = InteriorPoint().prepare(graph)
    first = run.solve({x: [[0.0]]}, check=True)
    for wanted in (7.0, -3.0):
        goal[0] = wanted
        assert run.solve(first.shifted(x, by=0), check=True)[x][0, 0] == pytest.approx(wanted, abs=1e-4)
