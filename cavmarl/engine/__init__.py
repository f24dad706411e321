"""The worlds that run: simulation, the order of a tick, signals and outputs shared by all zones.

Stands on `shards` and `handoff`; `parallel` runs it in processes.
"""
