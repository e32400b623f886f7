"""``unifg map``: a map of a log, its pose graph, and how far both can be trusted."""

from __future__ import annotations

from unifg.files.g2o import write_g2o
from unifg.files.ros_map import save_map
from unifg.scenarios import log_map
from unifg.scenarios.commands.outcome import Outcome, Progress
from unifg.scenarios.commands.replays import outcome_of

__all__ = ["SETTINGS", "run"]

SETTINGS = log_map.MapSettings


def run(settings: log_map.MapSettings, progress: Progress) -> Outcome:
    """Make a map of a log."""
    made, graph = log_map.map_log(settings.opened(), settings, progress)
    return outcome_of(
        made,
        {
            "map.yaml": lambda path: save_map(path, made.occupancy),
            "map.pgm": lambda path: path,  # which is there, as the image of the one before
            "graph.g2o": lambda path: write_g2o(path, graph),
        },
    )
