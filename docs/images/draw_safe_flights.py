"""Figures of the flights of FactorMPC as they are described: ``python -m docs.images.draw_safe_flights``."""

from pathlib import Path

from unifg.scenarios.quadrotor.situations import Kind
from unifg.scenarios.safe_flight import SafeSettings, run_safe_flights
from unifg.scenarios.scenes.safe_plot import picture
from unifg.style.figures import write_figure

CASES: tuple[Kind, ...] = ("static", "ellipse", "cluttered", "figure8", "ball")

for case in CASES:
    gammas = (0.0, 0.1, 1.3) if case == "ellipse" else None
    flights = run_safe_flights(SafeSettings(case=case, gamma=gammas, speed=(2.0,) if case == "figure8" else None))
    write_figure(Path(__file__).parent / f"quadrotor-cbf-{case}.png", picture(flights), 90)
