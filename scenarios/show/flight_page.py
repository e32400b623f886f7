"""The HTML page around a recorded flight: what happens now, legend, time slider, labels and camera.

The page forbids itself every connection (Content-Security-Policy). For pictures of a chosen moment and view, append
``#t=12.5&view=follow`` to its address (paused there); views are ``overview``, ``follow`` and ``top``.
"""

from __future__ import annotations

import html
import json

import numpy as np

from unifg.scenarios.log.flight_log import FlightLog
from unifg.scenarios.log.flight_metrics import FlightMetrics, estimated_parameters, flight_metrics, has_estimate
from unifg.scenarios.show.palette import css
from unifg.typing import Array, IntArray

__all__ = ["scene_page"]

_LEGEND = (
    ("robot", "line", "estimated past: the window that is smoothed"),
    ("trail", "line", "estimated past before that"),
    ("odometry", "thin", "true way, where it differs"),
    ("horizon", "line", "predicted future, and its shadow on the ground"),
    ("scan", "ring", "reach of the sensor"),
    ("fixed", "disc", "cylinder that has been seen"),
    ("wall", "ghost", "cylinder not seen yet"),
    ("estimate", "ghost", "landmark as believed: outline, and 2\u03c3 ellipse of its axis on top"),
    ("moving", "disc", "cylinder that moves"),
    ("goal", "disc", "target"),
)


def scene_page(log: FlightLog, ticks: IntArray, commands: list[str], script: str) -> str:
    """Put a page together.

    Args:
        log: the flight, for the words and numbers around the picture.
        ticks: (F,) ticks shown.
        commands: meshcat commands, packed, in base64.
        script: the viewer.

    Returns:
        The page; no part of it refers to another file.
    """
    metrics = flight_metrics(log)
    name = str(log.settings.get("scenario", "quadrotor"))
    parts = {
        "TITLE": html.escape(f"unifg: {name}" + (f", {log.layout.name}" if log.layout.name else "")),
        "OUTCOME": html.escape(_outcome(metrics)),
        "OUTCOME_CLASS": "good" if metrics["succeeded"] else "bad",
        "FACTS": _facts(metrics),
        "LEGEND": _legend(log),
        "DATA": json.dumps(_data(log, ticks), separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
        "COMMANDS": json.dumps(commands, indent=0),
        "VIEWER": script,
    }
    page = _PAGE
    for placeholder, text in parts.items():  # the viewer last: it is code in which no placeholder may be looked for
        page = page.replace(f"@@{placeholder}@@", text)
    return page


def _outcome(metrics: FlightMetrics) -> str:
    hits = metrics["collisions"]
    reached = "target reached" if metrics["reached"] else f"{metrics['target_distance_m']:.1f} m short of the target"
    collisions = "no collision" if hits == 0 else f"{hits} collision{'s' if hits > 1 else ''}"
    return f"{reached}, {collisions}" + (", interrupted by the user" if metrics["interrupted"] else "")


def _facts(metrics: FlightMetrics) -> str:
    settings, error, tick = metrics["settings"], metrics["position_error_m"], metrics["tick_ms"]
    solver = str(settings.get("solver", ""))
    if solver and settings.get("coupling"):
        solver += f" ({settings['coupling']})"
    rows = (
        ("solver", solver),
        ("seed", "" if settings.get("seed") is None else str(settings["seed"])),
        ("flown", f"{metrics['path_length_m']:.1f} m in {metrics['duration_s']:.1f} s"),
        ("closest approach", f"{max(0.0, metrics['min_clearance_m']):.2f} m"),
        ("position error", "" if error is None else f"{100 * error['rms']:.1f} cm rms"),
        ("estimate + plan", f"{tick['p50']:.1f} ms median" if tick["max"] > 0.0 else ""),
    )
    return "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in rows if value)


def _legend(log: FlightLog) -> str:
    absent = set()
    if not any(len(ids) for ids in log.seen):
        absent |= {"scan", "wall"}
    if not any(len(row.ids) for row in log.landmarks):
        absent.add("estimate")
    if not any(len(past) > 1 for past in log.pasts):
        absent.add("robot")
    if not has_estimate(log):
        absent.add("odometry")
    if not log.movers.shape[1]:
        absent.add("moving")
    words = {"trail": "way flown"} if {"robot", "odometry"} <= absent else {}
    words |= {"fixed": "cylinder"} if "wall" in absent else {}
    return "".join(
        f'<li><i class="{shape}" style="--c:{css(name)}"></i>{html.escape(words.get(name, text))}</li>'
        for name, shape, text in _LEGEND
        if name not in absent
    )


def _data(log: FlightLog, ticks: IntArray) -> dict[str, object]:
    """What the script of the page needs: numbers per frame, labels, and what the camera must see."""
    low, high = log.layout.size.tolist()
    mass = estimated_parameters(log)[0]
    speed = np.linalg.norm(log.truth[:, 7:], axis=1)
    clock = (log.estimate_ms + log.plan_ms).max() > 0.0
    error = np.linalg.norm(log.believed[:, :3] - log.truth[:, :3], axis=1)
    columns = {
        "speed": _rounded(speed, ticks, 2),
        "height": _rounded(log.truth[:, 2], ticks, 2),
        "clearance": _rounded(log.clearance, ticks, 2),
        "thrust": _rounded(log.controls[:, 3], ticks, 1),
        "error": _rounded(100.0 * error, ticks, 1) if has_estimate(log) else None,
        "mass": _rounded(log.parameters[:, 0], ticks, 3) if mass else None,
        "massSigma": _rounded(log.parameters_sigma[:, 0], ticks, 3) if mass else None,
        "landmarks": [len(log.landmarks[tick].ids) for tick in ticks.tolist()],
        "estimateMs": _rounded(log.estimate_ms, ticks, 1) if clock else None,
        "planMs": _rounded(log.plan_ms, ticks, 1) if clock else None,
        "status": [log.statuses[tick].lower() for tick in ticks.tolist()],
        "emergency": log.emergency[ticks].astype(int).tolist(),
    }
    return {
        "dt": log.dt,
        "duration": float(log.dt * ticks[-1]),
        "ticks": ticks.tolist(),
        "low": low,
        "high": high,
        "start": log.layout.start.round(3).tolist(),
        "target": log.layout.target.round(3).tolist(),
        "massTrue": round(float(log.parameters_true[0]), 3),
        "rows": columns,
    }


def _rounded(values: Array, ticks: IntArray, digits: int) -> list[float | None]:
    """Numbers of the ticks shown; those that are not finite become None."""
    return [round(value, digits) if np.isfinite(value) else None for value in values[ticks].tolist()]


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
.card { position: absolute; left: 12px; border-radius: 8px; background: rgba(255, 255, 255, .92);
  box-shadow: 0 1px 6px rgba(0, 0, 0, .2); }
#panel { top: 12px; width: 258px; padding: 12px 14px; max-height: calc(100vh - 100px); overflow: auto; }
#bar { right: 12px; bottom: 12px; padding: 8px 14px; display: flex; flex-wrap: wrap; gap: 12px; align-items: center; }
#bar input { flex: 1 1 200px; accent-color: #0a56a8; } #bar button, #bar select { font: inherit; padding: 3px 8px; }
#play { min-width: 76px; }
h1 { font-size: 15px; margin: 0 0 4px; } h2 { font-size: 13px; margin: 10px 0 3px; }
#outcome { font-weight: 600; margin: 0 0 6px; } .good { color: #00703c; } .bad, .alarm { color: #b3261e; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 1px 10px; margin: 0; } dt { color: #5b6472; }
dd { margin: 0; font-variant-numeric: tabular-nums; }
summary { cursor: pointer; font-weight: 600; margin-top: 10px; } ul { list-style: none; margin: 4px 0 0; padding: 0; }
li { display: flex; gap: 9px; align-items: center; margin: 3px 0; line-height: 1.25; } li i { flex: 0 0 18px; }
.disc, .ghost, .ring { height: 18px; border-radius: 50%; box-sizing: border-box; } .disc { background: var(--c); }
.ghost { background: color-mix(in srgb, var(--c) 35%, white); border: 1px solid var(--c); }
.ring { border: 2px solid var(--c); } .line { height: 4px; background: var(--c); }
.thin { height: 2px; background: var(--c); }
#clock { font-variant-numeric: tabular-nums; white-space: pre; }
.label { position: absolute; left: 0; top: 0; padding: 0 5px; border-radius: 4px; background: rgba(255, 255, 255, .82);
  font-weight: 600; font-size: 12px; pointer-events: none; white-space: nowrap; }
</style>
</head>
<body>
<div id="pane"></div>
<div id="labels"></div>
<div id="panel" class="card">
<h1>@@TITLE@@</h1>
<p id="outcome" class="@@OUTCOME_CLASS@@">@@OUTCOME@@</p>
<dl>@@FACTS@@</dl>
<h2>At this moment</h2>
<dl id="now"></dl>
<details open>
<summary>What you see</summary><ul>@@LEGEND@@</ul></details>
</div>
<div id="bar" class="card">
<button id="play">Pause</button>
<input id="slider" type="range" min="0" step="0.01" value="0" aria-label="time">
<span id="clock"></span>
<select id="speed" aria-label="speed"><option>0.25</option><option>0.5</option><option selected>1</option>
<option>2</option><option>4</option></select>
<select id="view" aria-label="view"><option value="overview">Overview</option>
<option value="follow">Follow drone</option>
<option value="top">From above</option></select>
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
const element = (id) => document.getElementById(id);
const viewer = new MeshCat.Viewer(element("pane"));
viewer.gui.domElement.style.display = "none";  // covers a corner, and the panels say what it says
for (const command of COMMANDS) {
  viewer.handle_command_bytearray(Uint8Array.from(atob(command), (c) => c.charCodeAt(0)));
}
const { Vector3 } = MeshCat.THREE, animator = viewer.animator, ROWS = DATA.rows;

// Time. The animator plays it, the slider seeks.
const slider = element("slider");
slider.max = DATA.duration;
function seek(time) {
  for (const action of animator.actions) { action.paused = false; action.enabled = true; }
  animator.seek(time);
  animator.time = time;
  slider.value = time;
}
element("play").onclick = () => {
  if (animator.playing) { animator.pause(); return; }
  seek(animator.time >= DATA.duration - 1e-6 ? 0 : animator.time);
  animator.play();
};
slider.oninput = () => { animator.pause(); seek(Number(slider.value)); };
for (const option of element("speed").options) { option.value = option.text; option.text += "\\u00d7"; }
element("speed").onchange = (event) => { animator.mixer.timeScale = Number(event.target.value); };

// Camera. World (x, y, z) is (x, z, -y) there. Overview and follow look along and across the way to the target.
const seen = (p) => new Vector3(p[0], p[2], -p[1]);
const drone = viewer.scene_tree.find(["meshcat", "drone"]).object;
const dronePlace = () => seen(drone.position.toArray());
const way = seen(DATA.target).sub(seen(DATA.start)).setY(0).normalize();
const right = new Vector3().crossVectors(way, new Vector3(0, 1, 0));
const away = (back, side, up) => way.clone().multiplyScalar(-back).addScaledVector(right, side)
  .add(new Vector3(0, up, 0)).normalize();
const { low, high } = DATA;
const corners = [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]]
  .flatMap((c) => [seen([...c, 0]), seen([...c, 2])]);
const middle = corners.reduce((sum, c) => sum.add(c), new Vector3()).divideScalar(corners.length);
const VIEWS = {
  overview: { direction: away(0.55, 0.75, 0.8), fov: 24 },
  top: { direction: away(0, 0.001, 1), fov: 10 },
  follow: { direction: away(1, 0.45, 0.7), fov: 30, distance: 13, ahead: 2.5 },
};
let view = "overview", followed = null, touched = false;
function room() {
  const width = window.innerWidth, height = window.innerHeight;
  return { width, height, left: width > 900 ? 300 : 0, bottom: element("bar").offsetHeight + 16 };
}
function look(target, direction, distance, fov) {
  Object.assign(viewer.camera, { fov, near: Math.max(0.1, 0.1 * distance), far: 4 * distance + 60 });
  viewer.camera.up.set(0, 1, 0);
  viewer.controls.target.copy(target);
  viewer.camera.position.copy(target).addScaledVector(direction, distance);
  viewer.controls.update();
  viewer.set_dirty();
}
function everything({ direction, fov }) {  // the nearest place on that ray from which all corners are in view
  const { width, height, left, bottom } = room();
  const half = Math.tan(fov * Math.PI / 360), wide = 0.96 * half * (width - left) / height;
  const tall = 0.96 * half * (height - bottom) / height;
  const across = new Vector3().crossVectors(new Vector3(0, 1, 0), direction).normalize();
  const upward = new Vector3().crossVectors(direction, across);
  const range = (target) => Math.max(...corners.map((corner) => {
    const arm = corner.clone().sub(target);
    return arm.dot(direction) + Math.max(Math.abs(arm.dot(across)) / wide, Math.abs(arm.dot(upward)) / tall);
  }));
  let target = middle.clone(), best = range(target);
  for (let step = 4; step > 0.01; step /= 2) {  // perspective: the middle of the ground is not that of its picture
    for (const move of [across, upward, across.clone().negate(), upward.clone().negate()]) {
      const moved = target.clone().addScaledVector(move, step);
      while (range(moved) < best - 1e-6) {
        best = range(moved);
        target = moved.clone();
        moved.addScaledVector(move, step);
      }
    }
  }
  look(target, direction, best, fov);
}
function show(name) {
  view = name;
  element("view").value = name;
  touched = false;
  const chosen = VIEWS[name];
  followed = chosen.ahead === undefined ? null : dronePlace();
  if (!followed) { everything(chosen); return; }
  look(followed.clone().addScaledVector(way, chosen.ahead), chosen.direction, chosen.distance, chosen.fov);
}
function arrange() {
  const { width, height, left, bottom } = room();
  viewer.camera.setViewOffset(width, height, -left / 2, bottom / 2, width, height);
  if (!touched) { show(view); }
  viewer.set_dirty();
}
element("view").onchange = (event) => show(event.target.value);
for (const kind of ["pointerdown", "wheel"]) { element("pane").addEventListener(kind, () => { touched = true; }); }
window.addEventListener("resize", arrange);
window.addEventListener("load", arrange);

// Labels and numbers.
const labels = [["start", () => seen([DATA.start[0], DATA.start[1], 0])], ["target", () => seen(DATA.target)],
  ["drone", dronePlace, true]].map(([text, place, above]) => {
  const box = Object.assign(document.createElement("div"), { className: "label", textContent: text });
  element("labels").appendChild(box);
  return { box, place, shift: above ? "-230%" : "12px" };
});
const fixed = (value, digits, unit) => (value === null ? "\\u2013" : `${value.toFixed(digits)} ${unit}`.trim());
const NOW = [
  ["speed", (k) => fixed(ROWS.speed[k], 2, "m/s")],
  ["height", (k) => fixed(ROWS.height[k], 2, "m")],
  ["clearance", (k) => fixed(ROWS.clearance[k], 2, "m")],
  ["thrust", (k) => fixed(ROWS.thrust[k], 1, "N")],
];
if (ROWS.error) { NOW.push(["position error", (k) => fixed(ROWS.error[k], 1, "cm")]); }
if (ROWS.mass) {
  const spread = (k) => `\\u00b1 ${fixed(ROWS.massSigma[k], 3, "kg")}`;
  NOW.push(["mass \\u00b1 \\u03c3", (k) => `${fixed(ROWS.mass[k], 3, "")} ${spread(k)}`]);
  NOW.push(["true mass", () => fixed(DATA.massTrue, 3, "kg")]);
}
if (ROWS.landmarks.some((count) => count > 0)) { NOW.push(["landmarks", (k) => String(ROWS.landmarks[k])]); }
if (ROWS.planMs) {
  NOW.push(["estimate, plan", (k) => `${fixed(ROWS.estimateMs[k], 1, "ms")}, ${fixed(ROWS.planMs[k], 1, "ms")}`]);
}
NOW.push(["plan", (k) => ROWS.status[k] + (ROWS.emergency[k] ? ": stored one flown" : "")]);
const cells = NOW.map(([name, text]) => {
  const head = element("now").appendChild(document.createElement("dt"));
  head.textContent = name;
  return { cell: element("now").appendChild(document.createElement("dd")), text };
});
function frameAt(time) {
  let first = 0, last = DATA.ticks.length - 1;
  while (first < last) {
    const half = (first + last + 1) >> 1;
    if (DATA.ticks[half] * DATA.dt <= time + 1e-6) { first = half; } else { last = half - 1; }
  }
  return first;
}
function update() {
  requestAnimationFrame(update);
  slider.value = animator.time;
  element("play").textContent = animator.playing ? "Pause" : "Play";
  const k = frameAt(Number(slider.value));
  const now = Number(slider.value).toFixed(2).padStart(5, "\\u2007");
  element("clock").textContent = `${now} s of ${DATA.duration.toFixed(1)} s`;
  for (const { cell, text } of cells) { cell.textContent = text(k); }
  cells[cells.length - 1].cell.className = ROWS.emergency[k] ? "alarm" : "";
  if (followed) {
    const step = dronePlace().sub(followed).setY(0);
    followed.add(step);
    viewer.controls.target.add(step);
    viewer.camera.position.add(step);
    viewer.set_dirty();
  }
  for (const { box, place, shift } of labels) {
    const at = place().project(viewer.camera);
    const x = (at.x + 1) / 2 * window.innerWidth, y = (1 - at.y) / 2 * window.innerHeight;
    box.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, ${shift})`;
    box.style.display = Math.abs(at.z) < 1 ? "" : "none";
  }
}
arrange();
for (const word of location.hash.slice(1).split("&")) {
  const [key, value] = word.split("=");
  if (key === "t") { animator.pause(); seek(Math.min(DATA.duration, Number(value) || 0)); }
  if (key === "view" && value in VIEWS) { viewer.scene.updateMatrixWorld(); show(value); }
}
update();
</script>
</body>
</html>
"""
