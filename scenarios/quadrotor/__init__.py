"""Quadrotor scenarios: flight between cylinders and walls, estimated and controlled by one graph."""
