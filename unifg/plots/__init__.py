"""Pictures of what a user stated and what came out: the factor graph, families of variables, the way of a solve."""
