"""Film a scene for README.md: `python docs/images/draw_moving.py SCENE.html [FILE.gif]`, which needs Chromium.

The page plays itself: a browser without a window opens the file that `unifg run` wrote, is led from moment to moment by
the page's own functions, and hands its pictures over; Pillow makes one of them. About 20 s for 8 s of film.
"""

from __future__ import annotations

import asyncio
import base64
import io
import json
import shutil
import subprocess
import sys
import tempfile
import urllib.request
from pathlib import Path
from typing import Any

from PIL import Image
from tornado.websocket import WebSocketClientConnection, websocket_connect

HERE = Path(__file__).resolve().parent
PAGE, SCALE = (640, 360), 1.25  # of a window so narrow that the panel takes no room
SIZE = (800, 450)
FRAMES, SECONDS = 90, 10.0  # shown
VIEW = "overview"  # of those the scene offers; the first where it has none of that name
COLOURS = 256
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
QUIET = ("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle", "--use-angle=swiftshader",
         "--enable-unsafe-swiftshader", "--hide-scrollbars", "--remote-debugging-port=0")  # fmt: skip
BARE = """
for (const card of document.querySelectorAll(".card")) { card.style.display = "none"; }
arrange();
show(VIEWS["%s"] ? "%s" : Object.keys(VIEWS)[0]);
DATA.duration
"""


async def film(scene: Path) -> list[Image.Image]:
    """Frames of a scene at equal distances of time."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        raise SystemExit("Chromium is needed to film a scene; none of these is there: " + ", ".join(BROWSERS))
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as home:  # the browser may still be writing
        size = f"--window-size={PAGE[0]},{PAGE[1]}"
        process = subprocess.Popen(
            [browser, *QUIET, size, f"--user-data-dir={home}", scene.resolve().as_uri()],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            port = await _port(Path(home) / "DevToolsActivePort")
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                (tab,) = (tab for tab in json.load(answer) if tab["type"] == "page")
            talk = await websocket_connect(tab["webSocketDebuggerUrl"], max_message_size=1 << 26)
            return await _frames(talk)
        finally:
            process.terminate()
            process.wait()


async def _port(note: Path) -> str:
    """Where the browser listens, once it does."""
    for _ in range(300):
        if note.is_file() and note.read_text():
            return note.read_text().split("\n")[0]
        await asyncio.sleep(0.1)
    raise SystemExit("the browser does not answer")


async def _frames(talk: WebSocketClientConnection) -> list[Image.Image]:
    number = 0

    async def ask(method: str, **parameters: Any) -> Any:
        nonlocal number
        number += 1
        await talk.write_message(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(str(await talk.read_message()))
            if answer.get("id") == number:
                return answer["result"]

    metrics = {"width": PAGE[0], "height": PAGE[1], "deviceScaleFactor": SCALE, "mobile": False}
    await ask("Emulation.setDeviceMetricsOverride", **metrics)
    duration = None
    while duration is None:  # the page is still being read
        await asyncio.sleep(0.5)
        reply = await ask("Runtime.evaluate", expression=BARE % (VIEW, VIEW))
        duration = reply["result"].get("value")
    frames = []
    for k in range(FRAMES):
        # Two frames of the page's own clock: one moves everything, the next draws it.
        wait = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        moment = f"stop({duration * k / (FRAMES - 1)}); viewer.set_dirty(); {wait}"
        await ask("Runtime.evaluate", expression=moment, awaitPromise=True)
        shot = await ask("Page.captureScreenshot", format="png")
        frames.append(Image.open(io.BytesIO(base64.b64decode(shot["data"]))).convert("RGB"))
    return frames


def main() -> None:
    """Write the film."""
    if len(sys.argv) < 2:
        raise SystemExit(__doc__)
    frames = asyncio.run(film(Path(sys.argv[1])))
    target = Path(sys.argv[2]) if len(sys.argv) > 2 else HERE / "demo.gif"
    # One palette for all frames, without dithering: what does not move stays the same to the pixel, and costs nothing.
    strip = Image.new("RGB", (SIZE[0], SIZE[1] * 6))
    for k in range(6):
        strip.paste(frames[k * (FRAMES - 1) // 5], (0, k * SIZE[1]))
    palette = strip.quantize(COLOURS, dither=Image.Dither.NONE)
    indexed = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    pause = round(1e3 * SECONDS / FRAMES)
    indexed[0].save(
        target,
        save_all=True,
        append_images=indexed[1:],
        duration=[pause] * (FRAMES - 1) + [1500],
        loop=0,
        optimize=True,
    )
    print(f"{target}: {target.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
