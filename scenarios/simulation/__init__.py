"""Simulated truths: what stands there, what moves, what sensors measure of it."""
