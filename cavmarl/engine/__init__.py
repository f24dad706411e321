"""The simulation of worlds: the order of a tick, and the signals and outputs of all zones.

It builds on `shards` and `handoff`; `parallel` runs it in several processes.
"""
