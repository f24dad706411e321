"""Compiled loops over what is recorded of a run."""
