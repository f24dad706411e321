"""Kernels of the phases of a tick, over W worlds and over the zones of one process."""
