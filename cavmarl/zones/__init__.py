"""The geometry of a division: zones of a map, their borders, and visibility over them.

Reads `roads` and `driving`; `shards` and `handoff` use it.
"""
