"""Avoidance as a cost and nothing else, as Bazzana et al. have it (section V, eq. 9 and 10)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import unifg as fg
from unifg.horizon import Context
from unifg.models import obstacles
from unifg.models.distance_map import DistanceMap, SmoothField
from unifg.models.potential import potential
from unifg.scenarios.ground.drive_parts import FAR_AWAY, Drive, predicted
from unifg.scenarios.ground.drive_settings import ControllerSettings
from unifg.scenarios.perception.tracks import nearest
from unifg.typing import ArrayLike

VORTEX = 0.3  # weight of the tangent vector: of those tried on random fields of discs, see docs/results/ta.md


@dataclass(frozen=True)
class Repulsion:
    """A potential around walls and tracked discs that pushes the hull; no distance is ever required."""

    settings: ControllerSettings
    field: SmoothField

    def state(self, graph: fg.Graph, x: fg.Selection, u: Any) -> None:
        """Add the costs."""
        s, n, m = self.settings, self.settings.horizon, self.settings.discs
        centre = graph.data("disc centres", np.full((n, m, 2), FAR_AWAY), each=True)
        reach = graph.data("disc reaches", np.zeros(m))
        vortex, sigma = VORTEX if s.avoidance == "vortex" else 0.0, s.weighted((s.potential_sigma,))[0]
        given = self.field.distance_map
        of_hull = SmoothField(DistanceMap(given.values - s.robot_radius, given.resolution, given.origin))
        walls = potential(obstacles.wall_distance(of_hull), vortex=vortex)
        discs = potential(obstacles.disc_clearance, vortex=vortex)
        graph.minimize(walls, x[1:], sigma=sigma, name="walls")
        graph.minimize(discs, x[1:], centre, reach, sigma=sigma, name="discs")

    def data(self, now: Context[Drive]) -> Mapping[str, ArrayLike]:
        """Predicted positions of the discs, and distances of the robot's centre from theirs when they touch."""
        s, n, m = self.settings, self.settings.horizon, self.settings.discs
        chosen = nearest(now.given.tracks, now.present, m)
        centres, reach = np.full((n, m, 2), FAR_AWAY), np.zeros(m)
        centres[:, : len(chosen)] = predicted(s, now.present, chosen)
        reach[: len(chosen)] = chosen.radius + s.robot_radius
        return {"disc centres": centres, "disc reaches": reach}
