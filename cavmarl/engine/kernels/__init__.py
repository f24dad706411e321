"""Kernels for the actions and the results of all agents."""
