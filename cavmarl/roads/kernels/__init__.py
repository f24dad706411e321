"""Compiled loops: plans to goals, steps of routes, signal phases, and static objects."""
