"""Make the picture of docs/howto/from-a-log.md: `python docs/images/draw_log.py LOG` with unifg[scenarios].

LOG is intel-corrected.log.gz, of the Radish collection.
"""

from __future__ import annotations

import sys
from pathlib import Path

from unifg.scenarios.log_map import MapSettings, map_log
from unifg.scenarios.scenes.log_scene import picture
from unifg.style.figures import write_figure

if __name__ == "__main__":
    file = Path(sys.argv[1])
    run, _ = map_log(MapSettings(file, simulated_odometry=True).opened(), MapSettings(file))
    out = Path(__file__).resolve().parent / "from-a-log.png"
    write_figure(out, picture(run), 90)
    print(out)
