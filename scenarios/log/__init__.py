"""What a run leaves behind, tick by tick, and the numbers that say how it went."""
