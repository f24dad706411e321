"""SUMO as global traffic: a process of its own for each world, and what is taken from it."""
