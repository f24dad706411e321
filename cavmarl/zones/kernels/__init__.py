"""Kernels for zone lookup, ghosts, borders and changes of owner."""
