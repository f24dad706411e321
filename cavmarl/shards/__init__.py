"""Shards: the vehicles and sensors of one zone in W worlds, and the phases of a tick.

Shards call the kernels of `driving`, `traffic` and `sensors`; `engine` orders the phases.
"""
