"""Worlds on nodes: processes without shared memory, each with some zones of the worlds."""
