"""Whether results are bit for bit the same: determinism, divisions, faults, kills.

Stands on `evaluate`; `cli` runs it.
"""
