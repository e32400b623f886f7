"""What a robot may rely on just now: samples looked at before they come in, and how fast it may go with the rest."""
