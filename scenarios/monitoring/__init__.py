"""Health monitoring: validation of samples, and the speed that the rest allows."""
