"""Roadside units that set variable speed limits: their table, observations and controllers."""
