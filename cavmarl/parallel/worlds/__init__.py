"""Worlds of this process, the arrays of their steps, and the message that makes them elsewhere."""
