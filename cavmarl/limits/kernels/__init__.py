"""Kernels of variable speed limits: sums over sections, choices, observations and rewards."""
