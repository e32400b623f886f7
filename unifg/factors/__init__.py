"""One factor: kernel, differences, whitening, losses, and a factor by itself."""
