"""The HTML page around a recorded scene: title, legend, time slider, labels and camera.

The page forbids itself every connection (Content-Security-Policy), so a scene cannot depend on a network by
mistake. For pictures of a chosen moment, append ``#t=12.5`` (paused there) or ``#t=12.5&follow`` to its address.
"""

from __future__ import annotations

import html
import json

import numpy as np

from unifg.scenarios.log.drive_log import EpisodeLog
from unifg.scenarios.log.drive_metrics import EpisodeMetrics, episode_metrics, pose_errors
from unifg.scenarios.show.palette import css
from unifg.scenarios.show.shapes import known_corners
from unifg.typing import IntArray

__all__ = ["scene_page"]

_SPEEDS = (1, 2, 4, 8)
_WATCHED = 40.0  # [s]; an episode starts at the lowest speed that shows it within this time

_LEGEND = (
    ("robot", "disc", "robot, where it truly is (pin above it)"),
    ("estimate", "ghost", "where the robot believes it is: lidar localisation"),
    ("odometry", "ghost", "where wheel odometry alone would put it"),
    ("scan", "dots", "lidar hits of this moment"),
    ("horizon", "line", "way the controller predicts for the next seconds"),
    ("trail", "line", "way driven so far"),
    ("plan", "line", "planned path"),
    ("goal", "flag", "goals"),
    ("fixed", "disc", "obstacle that is not on the map"),
    ("moving", "disc", "obstacle that moves"),
    ("detected", "ring", "obstacle as the robot has detected it"),
    ("wall", "block", "walls and furniture on the map"),
)


def scene_page(log: EpisodeLog, ticks: IntArray, commands: list[str], script: str) -> str:
    """Put a page together.

    Args:
        log: the episode, for the words and numbers around the picture.
        ticks: (F,) ticks shown.
        commands: meshcat commands, packed, in base64.
        script: the viewer.

    Returns:
        The page; no part of it refers to another file.
    """
    metrics = episode_metrics(log)
    parts = {
        "TITLE": html.escape(f"unifg: {log.scenario} on {log.occupancy.name}"),
        "OUTCOME": html.escape(_outcome(metrics)),
        "OUTCOME_CLASS": "good" if metrics["succeeded"] else "bad",
        "FACTS": _facts(metrics),
        "LEGEND": _legend(log),
        "DATA": json.dumps(_data(log, ticks), separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
        "COMMANDS": json.dumps(commands, indent=0),
        "VIEWER": script,
    }
    page = _PAGE
    for name, text in parts.items():  # the viewer last: it is code in which no placeholder may be looked for
        page = page.replace(f"@@{name}@@", text)
    return page


def _outcome(metrics: EpisodeMetrics) -> str:
    reached = f"{metrics['goals_reached']} of {metrics['goals']} goals reached"
    hits = metrics["collisions"]
    collisions = "no collision" if hits == 0 else f"{hits} collision{'s' if hits > 1 else ''}"
    return f"{reached}, {collisions}" + (", interrupted by the user" if metrics["interrupted"] else "")


def _facts(metrics: EpisodeMetrics) -> str:
    rows = (
        ("solver", f"{metrics['solver']} ({metrics['coupling']})"),
        ("seed", str(metrics["seed"])),
        ("driven", f"{metrics['path_length_m']:.1f} m in {metrics['duration_s']:.1f} s"),
        ("closest approach", f"{max(0.0, metrics['min_clearance_m']):.2f} m"),
        ("localisation error", f"{100 * metrics['localisation_error_m']['mean']:.1f} cm on average"),
        ("odometry error", f"{metrics['odometry_error_m']['max']:.2f} m at worst"),
    )
    return "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in rows)


def _legend(log: EpisodeLog) -> str:
    moving = log.moving()
    absent = {name for name, here in (("moving", moving.any()), ("fixed", (~moving).any())) if not here}
    if not any(len(found) for found in log.detected):
        absent.add("detected")
    return "".join(
        f'<li><i class="{shape}" style="--c:{css(name)}"></i>{html.escape(text)}</li>'
        for name, shape, text in _LEGEND
        if name not in absent
    )


def _data(log: EpisodeLog, ticks: IntArray) -> dict[str, object]:
    """What the script of the page needs: times, a line of numbers per frame, labels, and what the camera must see."""
    error, _ = pose_errors(log.estimate, log.true_pose)
    duration = float(log.dt * ticks[-1])
    labels = [{"text": "start", "at": log.start[:2].round(3).tolist()}]
    for index, goal in enumerate(log.goals):
        text = "goal" if len(log.goals) == 1 else f"goal {index + 1}"
        labels.append({"text": text, "at": goal[:2].round(3).tolist()})
    rounded = {
        "v": log.control[ticks, 0].round(2),
        "omega": log.control[ticks, 1].round(2),
        "error": (100.0 * error[ticks]).round(1),
        "clearance": np.where(np.isfinite(log.clearance), log.clearance, 99.0)[ticks].round(2),
    }
    return {
        "dt": log.dt,
        "duration": duration,
        "speed": next((speed for speed in _SPEEDS if duration / speed <= _WATCHED), _SPEEDS[-1]),
        "ticks": ticks.tolist(),
        "goals": len(log.goals),
        "goal": (log.goal_index[ticks] + 1).tolist(),
        "emergency": log.emergency[ticks].astype(int).tolist(),
        "corners": known_corners(log.occupancy).round(3).tolist(),
        "labels": labels,
        **{name: values.tolist() for name, values in rounded.items()},
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
#panel { position: absolute; left: 12px; top: 12px; width: 252px; padding: 12px 14px; border-radius: 8px;
  background: rgba(255, 255, 255, .92); box-shadow: 0 1px 6px rgba(0, 0, 0, .2);
  max-height: calc(100vh - 110px); overflow: auto; }
h1 { font-size: 15px; margin: 0 0 4px; }
#outcome { font-weight: 600; margin: 0 0 8px; } .good { color: #00703c; } .bad { color: #b3261e; }
dl { display: grid; grid-template-columns: auto 1fr; gap: 1px 10px; margin: 0 0 8px; }
dt { color: #5b6472; } dd { margin: 0; }
summary { cursor: pointer; font-weight: 600; } ul { list-style: none; margin: 6px 0 0; padding: 0; }
li { display: flex; gap: 9px; align-items: center; margin: 4px 0; line-height: 1.25; }
li i { flex: 0 0 18px; box-sizing: border-box; }
.disc, .ghost, .ring { height: 18px; border-radius: 50%; }
.disc, .block { background: var(--c); } .block { height: 12px; }
.ghost { background: color-mix(in srgb, var(--c) 40%, white); border: 1px solid var(--c); }
.ring { border: 2px solid var(--c); }
.line { height: 4px; background: var(--c); } .dots { height: 4px; border-bottom: 4px dotted var(--c); }
.flag { height: 16px; background: var(--c); clip-path: polygon(0 0, 100% 35%, 12% 70%, 12% 100%, 0 100%); }
#bar { position: absolute; left: 12px; right: 12px; bottom: 12px; padding: 8px 14px; border-radius: 8px;
  display: flex; gap: 12px;
  align-items: center; background: rgba(255, 255, 255, .92);
  box-shadow: 0 1px 6px rgba(0, 0, 0, .2); flex-wrap: wrap; }
#bar input { flex: 1 1 200px; accent-color: #0a56a8; }
#bar button { font: inherit; min-width: 76px; padding: 3px 8px; }
#readout { font-variant-numeric: tabular-nums; white-space: pre; } #readout b { color: #b3261e; }
.label { position: absolute; left: 0; top: 0; padding: 0 5px; border-radius: 4px; background: rgba(255, 255, 255, .82);
  font-weight: 600; font-size: 12px; pointer-events: none; white-space: nowrap; }
.minor { color: #6b7280; font-weight: 400; font-size: 11px; background: rgba(255, 255, 255, .6); }
</style>
</head>
<body>
<div id="pane"></div>
<div id="labels"></div>
<div id="panel">
<h1>@@TITLE@@</h1>
<p id="outcome" class="@@OUTCOME_CLASS@@">@@OUTCOME@@</p>
<dl>@@FACTS@@</dl>
<details open>
<summary>What you see</summary><ul>@@LEGEND@@</ul></details>
</div>
<div id="bar">
<button id="play">Pause</button>
<input id="slider" type="range" min="0" step="0.01" value="0" aria-label="time">
<span id="readout"></span>
<select id="speed" aria-label="speed"><option>1</option>
<option>2</option><option>4</option><option>8</option></select>
<button id="follow">Follow robot</button>
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
const THREE = MeshCat.THREE, animator = viewer.animator;

// Time: the animator plays; the slider seeks.
const slider = byId("slider"), speed = byId("speed"), playButton = byId("play");
slider.max = DATA.duration;
for (const option of speed.options) { option.value = option.text; option.text += "\\u00d7"; }
speed.value = DATA.speed;
const setSpeed = () => { animator.mixer.timeScale = Number(speed.value); };
speed.onchange = setSpeed;
setSpeed();
function seek(time) {
  for (const action of animator.actions) { action.paused = false; action.enabled = true; }
  animator.seek(time);
  animator.time = time;
  slider.value = time;
}
function play() {
  if (animator.time >= DATA.duration - 1e-6) { seek(0); } else { seek(animator.time); }
  animator.play();
}
playButton.onclick = () => { if (animator.playing) { animator.pause(); } else { play(); } };
slider.oninput = () => { animator.pause(); seek(Number(slider.value)); };

// Camera: the whole building, unless the robot is followed. World (x, y, z) is (x, z, -y) for the camera.
const toCamera = (p) => new THREE.Vector3(p[0], p[2], -p[1]);
const robot = viewer.scene_tree.find(["meshcat", "robot"]).object;
const robotPlace = () => toCamera(robot.position.toArray());
const odometry = viewer.scene_tree.find(["meshcat", "odometry"]).object;
const corners = DATA.corners.flatMap((c) => [toCamera([...c, 0]), toCamera([...c, 0.6])]);
const centre = corners.reduce((sum, c) => sum.add(c), new THREE.Vector3()).divideScalar(corners.length);
const towardsCamera = new THREE.Vector3(0, Math.sin(1.1), Math.cos(1.1));
let followed = null, touched = false;
function size() {
  const width = window.innerWidth, height = window.innerHeight;
  const left = width > 900 ? 276 : 0, bottom = byId("bar").offsetHeight + 16;
  return { width, height, left, bottom };
}
function look(target, distance) {
  viewer.camera.fov = 20;
  viewer.camera.near = 0.2;
  viewer.camera.far = 10 * distance + 100;
  viewer.controls.target.copy(target);
  viewer.camera.position.copy(target).addScaledVector(towardsCamera, distance);
  viewer.controls.update();
  viewer.set_dirty();
}
function wholeBuilding() {
  const { width, height, left, bottom } = size();
  const half = Math.tan(Math.PI / 18);
  const across = half * (width - left) / height * 0.95, along = half * (height - bottom) / height * 0.95;
  const up = new THREE.Vector3(0, towardsCamera.z, -towardsCamera.y);
  let distance = 1;
  for (const corner of corners) {
    const arm = corner.clone().sub(centre);
    const needed = Math.max(Math.abs(arm.x) / across, Math.abs(arm.dot(up)) / along);
    distance = Math.max(distance, arm.dot(towardsCamera) + needed);
  }
  look(centre, distance);
}
function arrange() {
  const { width, height, left, bottom } = size();
  viewer.camera.setViewOffset(width, height, -left / 2, bottom / 2, width, height);
  if (!touched && !followed) { wholeBuilding(); }
  viewer.set_dirty();
}
function follow(on) {
  followed = on ? robotPlace() : null;
  byId("follow").textContent = on ? "Whole building" : "Follow robot";
  touched = false;
  if (on) { look(followed, 30); } else { wholeBuilding(); }
}
byId("follow").onclick = () => follow(!followed);
byId("pane").addEventListener("pointerdown", () => { touched = true; });
byId("pane").addEventListener("wheel", () => { touched = true; });
window.addEventListener("resize", arrange);
window.addEventListener("load", arrange);

// Labels and the line of numbers.
const labels = DATA.labels.map((label) => ({ text: label.text, place: () => toCamera([...label.at, 0]) }));
labels.push({ text: "odometry alone", place: () => toCamera(odometry.position.toArray()), minor: true });
labels.push({ text: "robot", place: robotPlace });
for (const label of labels) {
  label.element = document.createElement("div");
  label.element.className = label.minor ? "label minor" : "label";
  label.element.textContent = label.text;
  byId("labels").appendChild(label.element);
}
function frameAt(time) {
  let low = 0, high = DATA.ticks.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (DATA.ticks[middle] * DATA.dt <= time + 1e-6) { low = middle; } else { high = middle - 1; }
  }
  return low;
}
function update() {
  requestAnimationFrame(update);
  slider.value = animator.time;
  playButton.textContent = animator.playing ? "Pause" : "Play";
  const time = Number(slider.value), k = frameAt(time);
  const pad = (x, digits, width) => x.toFixed(digits).padStart(width, "\\u2007");
  byId("readout").innerHTML = `${pad(time, 1, 5)} s of ${DATA.duration.toFixed(1)} s   `
    + `speed ${pad(DATA.v[k], 2, 5)} m/s   turn ${pad(DATA.omega[k], 2, 5)} rad/s   `
    + `goal ${DATA.goal[k]}/${DATA.goals}   localisation error ${pad(DATA.error[k], 1, 4)} cm   `
    + `clearance ${pad(DATA.clearance[k], 2, 4)} m` + (DATA.emergency[k] ? "   <b>stored plan</b>" : "");
  if (followed) {
    const step = robotPlace().sub(followed);
    followed.add(step);
    viewer.controls.target.add(step);
    viewer.camera.position.add(step);
    viewer.set_dirty();
  }
  const pixels = (p) => [(p.x + 1) / 2 * window.innerWidth, (1 - p.y) / 2 * window.innerHeight];
  const [robotX, robotY] = pixels(robotPlace().project(viewer.camera));
  for (const label of labels) {
    const place = label.place().project(viewer.camera);
    const [x, y] = pixels(place);
    const covered = label.minor && Math.abs(x - robotX) < 75 && Math.abs(y - robotY) < 20;
    label.element.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px) translate(-50%, 9px)`;
    label.element.style.display = Math.abs(place.z) < 1 && !covered ? "" : "none";
  }
}
arrange();
for (const word of location.hash.slice(1).split("&")) {
  if (word.startsWith("t=")) { animator.pause(); seek(Math.min(DATA.duration, Number(word.slice(2)) || 0)); }
  if (word === "follow") { viewer.scene.updateMatrixWorld(); follow(true); }
}
update();
</script>
</body>
</html>
"""
