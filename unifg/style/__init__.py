"""One look for scenes and plots."""
