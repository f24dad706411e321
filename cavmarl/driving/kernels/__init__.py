"""Compiled loops: driver models, lanes, junctions, motion, contacts."""
