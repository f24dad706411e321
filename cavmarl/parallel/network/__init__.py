"""Connections between processes: one interface, over TCP or MPI."""
