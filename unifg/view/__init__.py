"""Anything that was solved, looked at: scenes in three dimensions as pages of their own."""
