"""Kernels that record agents and near misses of a run."""
