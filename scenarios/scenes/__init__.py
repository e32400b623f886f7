"""Pictures, scenes and pages of runs."""
