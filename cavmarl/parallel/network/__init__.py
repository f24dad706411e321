"""Connections between processes over TCP or MPI, and the Ray cluster that may start them."""
