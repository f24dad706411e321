"""Compiled loops of driver networks, with equal results on every processor."""
