"""Ground: errors, seeds, memory, and what all kernels share.

Imports nothing of the package.
"""
