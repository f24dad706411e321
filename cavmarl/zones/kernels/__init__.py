"""Compiled loops: which zone a place is in, ghosts, borders, rows that change hands."""
