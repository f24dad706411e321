"""The geometry of a division: zones of a map, their borders, and visibility across borders.

This package depends on `roads` and `driving`; `shards` and `handoff` use it.
"""
