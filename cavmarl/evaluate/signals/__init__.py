"""Measures controllers of signals, beside SUMO with the map's own programs."""
