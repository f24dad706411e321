"""How vehicles drive: their record, their types, and the kernels of driver models.

Reads `roads`; `shards` runs its kernels in each tick.
"""
