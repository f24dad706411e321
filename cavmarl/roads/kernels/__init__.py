"""Compiled loops: plans to goals, steps of routes, phases of signals, static objects."""
