"""Checks that results are bit for bit the same: determinism, divisions, faults, kills.

This package builds on `evaluate`; `cli` runs the checks.
"""
