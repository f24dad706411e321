"""Basics of all folders: errors, seeds, memory, and shared kernels.

This package imports nothing from the rest of cavmarl.
"""
