"""Kernels of plain geometry, random numbers, lists and searches that every domain uses."""
