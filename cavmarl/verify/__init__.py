"""Checks that results are bit for bit the same: repeated, divided into zones, with faults.

This package builds on `evaluate`; `cli` runs the checks.
"""
