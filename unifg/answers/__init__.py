"""What is asked of a graph: solve, check, how good, how sure, and why not."""
