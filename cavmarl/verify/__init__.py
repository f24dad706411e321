"""Checks that results are bit for bit the same: determinism, divisions, faults, kills.

It builds on `evaluate`; `cli` runs it.
"""
