"""Evacuations: a plan on a map, the world that follows from it, its run, and a page of results."""
