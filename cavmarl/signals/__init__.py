"""Signals that agents control: their programs, tables, observations and rewards."""
