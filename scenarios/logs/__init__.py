"""Logs of runs, tick by tick, and their metrics."""
