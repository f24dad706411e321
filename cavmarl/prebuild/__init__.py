"""Builds the library of compiled kernels that a wheel brings.

Stands on `core`.
"""
