"""Coordinators of divided worlds, their journal and the monitor of invariants."""
