"""Map files: their conversion to SUMO networks, checks, and buildings.

Builds on `roads`.
"""
