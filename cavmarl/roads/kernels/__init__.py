"""Compiled loops: plans to goals, steps of routes, phases of signals, what stands on a map."""
