"""Questions to a graph: solve, check, fit, covariance, and reasons of failure."""
