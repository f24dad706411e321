"""Kernels for geometry, random numbers, lists and searches that all folders use."""
