"""Compiled loops of driver networks: the same bytes on every processor."""
