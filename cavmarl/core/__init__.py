"""Basics of all folders: errors, seeds, memory, and shared kernels.

It imports nothing from the rest of the package.
"""
