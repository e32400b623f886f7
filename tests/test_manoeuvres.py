"""Two manoeuvres, two backends: what must come out, what is kept of the way there, and what is drawn and written."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.lines import Line2D
from matplotlib.patches import Circle

import unifg as fg
from judge import kkt
from unifg.models import unicycle
from unifg.scenarios import cli, manoeuvre_plots
from unifg.scenarios.manoeuvres import (
    CASES,
    Manoeuvre,
    ManoeuvreSettings,
    case_metrics,
    run_manoeuvre,
    state_problem,
    table,
)
from unifg.scenarios.palette import css
from unifg.solvers import SQP, AugmentedLagrangian

SOLVERS = ("alm", "sqp")
BEHIND = 59.47520  # J of the path behind the robot without a cost on changes, by IPOPT and by Crocoddyl's Box-FDDP


@cache
def solved(name: str, solver: str) -> Manoeuvre:
    return run_manoeuvre(CASES[name], solver)


both = pytest.mark.parametrize("solver", SOLVERS)
all_cases = pytest.mark.parametrize("name", CASES)
