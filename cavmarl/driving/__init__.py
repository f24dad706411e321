"""Vehicles and their drivers: the vehicle record, vehicle types, and the kernels of driver models.

This package depends on `roads`; `shards` runs the kernels in each tick.
"""
