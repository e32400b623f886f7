"""Globalisation: merit functions, line search, damping, and feasibility restoration."""
