"""Kernels for digests of rows and checks of invariants."""
