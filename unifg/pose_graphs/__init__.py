"""Pose graphs: the data, residuals in two conventions, first guesses, and made-up examples."""

from unifg.pose_graphs import judging as _judging  # noqa: F401  enters PoseGraph.verdict
from unifg.pose_graphs.certificate import certify
from unifg.pose_graphs.consistency import pairwise_consistent
from unifg.pose_graphs.generate import manhattan, sphere
from unifg.pose_graphs.information import indefinite, repaired
from unifg.pose_graphs.initialise import Start, best_guess, chordal, lago, odometric, starts
from unifg.pose_graphs.judgement import judge
from unifg.pose_graphs.pose_graph import Edges, PoseGraph, Priors, Sightings
from unifg.pose_graphs.residuals import bearing, bearing_range, distance, sighting
from unifg.pose_graphs.smoothed import from_smoother
from unifg.pose_graphs.submaps import Submaps
from unifg.pose_graphs.verdict import Verdict

__all__ = [
    "Edges",
    "PoseGraph",
    "Priors",
    "Sightings",
    "Start",
    "Submaps",
    "Verdict",
    "bearing",
    "bearing_range",
    "best_guess",
    "certify",
    "chordal",
    "distance",
    "from_smoother",
    "indefinite",
    "judge",
    "lago",
    "manhattan",
    "odometric",
    "pairwise_consistent",
    "repaired",
    "sighting",
    "sphere",
    "starts",
]


__dir__ = __all__.copy
