"""Whether results are bit for bit the same: determinism, divisions, faults, replays.

Stands on `evaluate`; `cli` runs it.
"""
