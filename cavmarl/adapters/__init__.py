"""Views of a world for libraries that do not read PettingZoo."""
