"""Road networks: immutable arrays, read from SUMO networks."""
