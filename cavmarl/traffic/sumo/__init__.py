"""SUMO as global traffic: one process per world, and the data exchanged with it."""
