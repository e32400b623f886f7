"""The command line of each scenario, and what it writes."""
