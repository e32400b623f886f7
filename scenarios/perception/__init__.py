"""Perception of obstacles and landmarks that no map shows."""
