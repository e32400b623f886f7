"""The quadrotor: estimation, control among landmarks and by barriers, and controllers to compare with."""
