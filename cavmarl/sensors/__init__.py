"""Sensors: the observations of agents, and sensors mounted on their vehicles.

The kernels are in `kernels/`; `shards` runs them at the end of each step.
"""
