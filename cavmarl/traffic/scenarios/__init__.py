"""Staged conflicts: scenes, actors, scripts, motions, and the library of scenarios."""
