"""Processes that compute the mounted sensors of the worlds of another process."""
