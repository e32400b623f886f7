"""A primal-dual interior point: the barrier problem, its directions, the filter, and the loop over them."""
