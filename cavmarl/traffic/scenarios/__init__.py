"""Scripted conflicts: casts, scripts, motions, and the library of scenarios."""
