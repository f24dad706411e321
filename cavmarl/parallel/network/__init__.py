"""Connections with processes that share nothing, and the Ray cluster that may start them."""
