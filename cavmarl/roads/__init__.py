"""Road networks: immutable arrays, read from SUMO networks, and routing over them.

Stands on `core`; every domain above reads it.
"""
