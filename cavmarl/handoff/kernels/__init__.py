"""Compiled loops: digests of rows and checks of invariants."""
