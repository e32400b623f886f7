"""What one factor is: kernel, differences, whitening, losses, and a factor by itself."""
