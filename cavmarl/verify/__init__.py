"""Checks that a run that is repeated, divided into zones or hit by faults has the same bits.

This package builds on `evaluate`; `cli` runs the checks.
"""
