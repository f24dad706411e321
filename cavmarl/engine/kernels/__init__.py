"""Compiled loops over the results and the actions of all agents."""
