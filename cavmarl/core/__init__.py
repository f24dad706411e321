"""Basics of all folders: errors, seeds, memory, and shared kernels.

Imports nothing from the rest of the package.
"""
