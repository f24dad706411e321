"""SUMO as global traffic: one process for each world, and the data exchanged with it."""
