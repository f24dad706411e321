"""Sensors: the observations of agents, and sensors mounted on their vehicles.

The package `shards` runs the kernels in `kernels/` at the end of each step.
"""
