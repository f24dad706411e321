"""Vehicles and their drivers: the vehicle record, vehicle types, and the kernels of driver models.

This folder reads `roads`. `shards` runs its kernels in each tick.
"""
