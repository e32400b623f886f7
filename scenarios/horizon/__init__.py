"""Planning again and again with one prepared graph, whatever the robot: parts of a graph, the loop, the past."""
