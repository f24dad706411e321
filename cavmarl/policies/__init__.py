"""Drivers for agents' vehicles: loading them, checking that they fit, and exporting them.

Depends on `env`.
"""
