"""Compiled loops: departures, entering, leaving and rerouting."""
