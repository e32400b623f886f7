"""Campaigns: many episodes on one machine or many, a line each, and what the lines say together."""
