"""Departures, routes and the seeded generator."""
