"""Ways through the plane: on grids, among bodies, as rows of poses."""
