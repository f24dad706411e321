"""The simulation of worlds: the order of a tick, and the signals and outputs of all zones.

This package builds on `shards` and `handoff`; `parallel` runs it in several processes.
"""
