"""Worlds in worker processes: the pool of the caller, and the jobs of the workers."""
