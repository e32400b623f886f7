"""File formats: pose graphs (g2o, TORO), trajectories (TUM, KITTI), robot logs (CARMEN) and occupancy maps (ROS).

Each format is a module of its own; importing one reads nothing else.
"""
