"""Sensors mounted on agents' vehicles, each with a place, a rate, a range and errors of its own."""
