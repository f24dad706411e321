"""Sensors mounted on agents' vehicles, each with its own pose, rate, range and errors."""
