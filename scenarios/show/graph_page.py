"""The HTML page around the scene of a solved pose graph: numbers, legend, iterations to step through.

As the page of an episode it forbids itself every connection (Content-Security-Policy). For a picture of a chosen
iterate, append ``#k=0`` to its address.
"""

from __future__ import annotations

import html
import json

import numpy as np

from unifg.scenarios.pose_graph import SolvedGraph
from unifg.scenarios.show.palette import css

__all__ = ["solve_page"]

_MARGIN = 0.3  # of the size of the solution: how far around it the camera looks for the start


def solve_page(solved: SolvedGraph, shown: list[int], commands: list[str], script: str) -> str:
    """Put a page together.

    Args:
        solved: the solved graph, for the words and numbers around the picture.
        shown: which of ``solved.steps`` are drawn.
        commands: meshcat commands, packed, in base64.
        script: the viewer.

    Returns:
        The page; no part of it refers to another file.
    """
    solution = solved.solution
    parts = {
        "TITLE": html.escape(f"unifg: {solved.name}"),
        "OUTCOME": html.escape(f"{solution.status.value}"),
        "OUTCOME_CLASS": "good" if solution.converged else "bad",
        "FACTS": _facts(solved),
        "LEGEND": _legend(solved),
        "DATA": json.dumps(_data(solved, shown), separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
        "COMMANDS": json.dumps(commands, indent=0),
        "VIEWER": script,
    }
    page = _PAGE
    for name, text in parts.items():  # the viewer last: it is code in which no placeholder may be looked for
        page = page.replace(f"@@{name}@@", text)
    return page


def _facts(solved: SolvedGraph) -> str:
    graph, settings = solved.after, solved.settings
    rows = [
        ("poses", f"{len(graph.poses)} in {graph.group.point_dim}D"),
        ("edges", f"{len(graph.edges)}, {len(graph.closures)} close loops"),
        ("landmarks", f"{len(graph.landmarks)}" if len(graph.landmarks) else ""),
        ("first guess", settings.init),
        ("solver", settings.solver),
        ("residual", settings.residual),
        ("robust loss", settings.robust or ""),
        ("outliers", f"{int(solved.outliers.sum())}" if solved.loss else ""),
        ("\u03c7\u00b2 before", f"{solved.chi2[1]:.7g}"),
        ("\u03c7\u00b2 after", f"{solved.chi2[2]:.7g}"),
        ("without outliers", f"{solved.chi2_inliers:.7g}" if solved.outliers.any() else ""),
        ("solved in", f"{solved.solution.iterations} iterations, {1e3 * solved.seconds['solve']:.0f} ms"),
    ]
    return "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in rows if value)


def _legend(solved: SolvedGraph) -> str:
    entries = [
        ("start", "odometry", "trajectory at the start", True),
        ("trajectory", "robot", "trajectory: poses joined by odometry", True),
        ("closures", "closure", "loop closures: the same place seen again", True),
    ]
    if solved.outliers.any():
        entries.append(("outliers", "outlier", "loop closures taken for outliers", True))
    if len(solved.after.landmarks):
        entries.append(("landmarks", "landmark", "landmarks", True))
    return "".join(
        f'<li><label><input type="checkbox" data-part="{part}"{" checked" if on else ""}>'
        f'<i style="--c:{css(colour)}"></i>{html.escape(text)}</label></li>'
        for part, colour, text, on in entries
    )


def _data(solved: SolvedGraph, shown: list[int]) -> dict[str, object]:
    """What the script needs: the iterates, their costs, and what the camera must see."""
    size = solved.after.group.point_dim
    points, start = solved.after.poses[:, :size], solved.before.poses[:, :size]
    low, high = points.min(axis=0), points.max(axis=0)
    reach = _MARGIN * float((high - low).max())
    low = np.maximum(np.minimum(low, start.min(axis=0)), low - reach)
    high = np.minimum(np.maximum(high, start.max(axis=0)), high + reach)
    if size == 2:
        low, high = np.append(low, 0.0), np.append(high, 0.0)
    costs = {row.number: row.cost for row in solved.solution.history}
    numbers = [solved.step_numbers[k] for k in shown]
    return {
        "steps": shown,
        "numbers": numbers,
        "costs": [float(costs.get(number, solved.solution.cost)) for number in numbers],
        "low": low.round(4).tolist(),
        "high": high.round(4).tolist(),
        "planar": size == 2,
    }


_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; \
script-src 'unsafe-inline' 'unsafe-eval'; style-src 'unsafe-inline'; img-src data: blob:; worker-src blob:">
<meta name="viewport" content="width=device-width">
<title>@@TITLE@@</title>
<style>
body { margin: 0; overflow: hidden; background: #eceef0; color: #1d2430;
  font: 13px/1.4 system-ui, "DejaVu Sans", sans-serif; }
#pane { width: 100vw; height: 100vh; overflow: hidden; }
#panel { position: absolute; left: 12px; top: 12px; width: 250px; padding: 10px 14px; border-radius: 8px;
  background: rgba(255, 255, 255, .92); box-shadow: 0 1px 6px rgba(0, 0, 0, .2); }
h1 { font-size: 15px; margin: 0 0 2px; overflow-wrap: anywhere; }
#outcome { margin: 0 0 6px; } .good { color: #0b7a3b; } .bad { color: #b3261e; font-weight: 600; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 1px 10px; margin: 0 0 8px; } dt { color: #5b6472; }
dd { margin: 0; text-align: right; font-variant-numeric: tabular-nums; }
ul { list-style: none; margin: 0; padding: 0; } li label { display: flex; gap: 7px; align-items: center; }
li i { width: 18px; height: 4px; background: var(--c); flex: none; }
#bar { position: absolute; left: 12px; right: 12px; bottom: 12px; padding: 8px 14px; border-radius: 8px;
  display: flex; gap: 12px; align-items: center; background: rgba(255, 255, 255, .92);
  box-shadow: 0 1px 6px rgba(0, 0, 0, .2); flex-wrap: wrap; }
#bar input { flex: 1 1 200px; accent-color: #0a56a8; }
#bar button { font: inherit; min-width: 76px; padding: 3px 8px; }
#readout { font-variant-numeric: tabular-nums; white-space: pre; }
</style>
</head>
<body>
<div id="pane"></div>
<div id="panel">
<h1>@@TITLE@@</h1>
<p id="outcome" class="@@OUTCOME_CLASS@@">@@OUTCOME@@</p>
<dl>@@FACTS@@</dl>
<ul>@@LEGEND@@</ul>
</div>
<div id="bar">
<button id="play">Play</button>
<input id="slider" type="range" min="0" step="1" value="0" aria-label="iteration">
<span id="readout"></span>
<button id="whole">Whole graph</button>
</div>
<script>
const DATA = @@DATA@@;
const COMMANDS = @@COMMANDS@@;
</script>
<script>
@@VIEWER@@
</script>
<script>
"use strict";
const byId = (id) => document.getElementById(id);
const viewer = new MeshCat.Viewer(byId("pane"));
for (const command of COMMANDS) {
  viewer.handle_command_bytearray(Uint8Array.from(atob(command), (c) => c.charCodeAt(0)));
}
const THREE = MeshCat.THREE;
viewer.gui.domElement.style.display = "none";  // covers the corner, and the panel says what it says
const find = (...path) => viewer.scene_tree.find(["meshcat", ...path]).object;

// Iterates: one is shown at a time, with the parts that are ticked.
const slider = byId("slider"), boxes = [...document.querySelectorAll("input[data-part]")];
slider.max = DATA.steps.length - 1;
function show() {
  const wanted = Object.fromEntries(boxes.map((box) => [box.dataset.part, box.checked]));
  find("start").visible = wanted.start;
  find("landmarks").visible = wanted.landmarks !== false;
  DATA.steps.forEach((step, k) => {
    for (const part of ["trajectory", "closures", "outliers"]) {
      find("steps", String(step), part).visible = k === Number(slider.value) && wanted[part] !== false;
    }
  });
  const k = Number(slider.value);
  byId("readout").textContent = `iteration ${DATA.numbers[k]}   cost ${DATA.costs[k].toPrecision(7)}`;
  viewer.set_dirty();
}
boxes.forEach((box) => { box.onchange = show; });
let timer = null;
function stop() { clearInterval(timer); timer = null; byId("play").textContent = "Play"; }
function play() {
  slider.value = 0;
  show();
  byId("play").textContent = "Pause";
  timer = setInterval(() => {
    slider.value = Number(slider.value) + 1;
    show();
    if (Number(slider.value) >= DATA.steps.length - 1) { stop(); }
  }, 600);
}
byId("play").onclick = () => { if (timer) { stop(); } else { play(); } };
slider.oninput = () => { stop(); show(); };

// Camera: the whole solution, from above if it is planar. World (x, y, z) is (x, z, -y) for the camera.
const toCamera = (p) => new THREE.Vector3(p[0], p[2], -p[1]);
const corners = [];
for (let k = 0; k < 8; k++) {
  corners.push(toCamera([0, 1, 2].map((axis) => ((k >> axis) & 1 ? DATA.high : DATA.low)[axis])));
}
const centre = corners.reduce((sum, c) => sum.add(c), new THREE.Vector3()).divideScalar(8);
const towardsCamera = DATA.planar ? new THREE.Vector3(0, 1, 1e-4).normalize()
  : new THREE.Vector3(0.55, 0.5, 0.67).normalize();
let touched = false;
function wholeGraph() {
  const width = window.innerWidth, height = window.innerHeight;
  const left = width > 700 ? 290 : 0, bottom = byId("bar").offsetHeight + 20;
  viewer.camera.setViewOffset(width, height, -left / 2, bottom / 2, width, height);
  if (touched) { return viewer.set_dirty(); }
  viewer.camera.fov = 20;
  const half = Math.tan(Math.PI / 18);
  const across = half * (width - left) / height * 0.92, along = half * (height - bottom) / height * 0.92;
  const right = new THREE.Vector3().crossVectors(new THREE.Vector3(0, 1, 0), towardsCamera).normalize();
  const up = new THREE.Vector3().crossVectors(towardsCamera, right);
  let distance = 1e-3;
  for (const corner of corners) {
    const arm = corner.clone().sub(centre);
    const needed = Math.max(Math.abs(arm.dot(right)) / across, Math.abs(arm.dot(up)) / along);
    distance = Math.max(distance, arm.dot(towardsCamera) + needed);
  }
  viewer.camera.near = 0.01 * distance;
  viewer.camera.far = 20 * distance;
  viewer.controls.target.copy(centre);
  viewer.camera.position.copy(centre).addScaledVector(towardsCamera, distance);
  viewer.controls.update();
  viewer.set_dirty();
}
byId("whole").onclick = () => { touched = false; wholeGraph(); };
byId("pane").addEventListener("pointerdown", () => { touched = true; });
byId("pane").addEventListener("wheel", () => { touched = true; });
window.addEventListener("resize", wholeGraph);
window.addEventListener("load", wholeGraph);
wholeGraph();
slider.value = DATA.steps.length - 1;
const chosen = location.hash.match(/^#k=([0-9]+)$/);
if (chosen) { slider.value = Number(chosen[1]); }
show();
</script>
</body>
</html>
"""
