"""Bundles of arrays that kernels take together, codes, and questions about a vehicle's row."""
