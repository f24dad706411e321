"""Connections between processes over TCP or MPI, and actors of a Ray cluster."""
