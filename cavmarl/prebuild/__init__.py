"""Builds the library of compiled kernels for a wheel.

Builds on `core`.
"""
