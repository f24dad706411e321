"""Reads SUMO networks: lanes, links, conflicts, signals and their programs."""
