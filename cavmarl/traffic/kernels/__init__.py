"""Compiled loops of departures, entering, leaving and rerouting."""
