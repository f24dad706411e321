"""Road networks: immutable arrays, a reader for SUMO networks, and routing.

Builds on `core`; all folders above use it.
"""
