"""Road networks: immutable arrays, a reader for SUMO networks, and routing.

This package depends on `core`; all higher packages use it.
"""
