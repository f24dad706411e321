"""Compiled loops: choices of greens, counts on lanes, observations and rewards of signals."""
