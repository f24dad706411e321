"""How ownership is run around the shards of a divided world: shards, transfers, repartitioning.

Drives the pure core in `ownership`; `engine` calls it in each tick.
"""
