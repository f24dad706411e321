"""Builds the library of compiled kernels for a wheel.

This package depends on `core`.
"""
