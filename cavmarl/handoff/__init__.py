"""Ownership in divided worlds: coordinators, transfers between shards, repartitioning.

It runs the pure core in `ownership`; `engine` calls it in each tick.
"""
