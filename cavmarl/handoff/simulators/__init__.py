"""Other simulators that run zones of a world."""
