"""What makes steps from bad guesses safe: merits, a line search, damping, and the way to the least violation."""
