"""Compiled loops: who departs, enters, leaves and looks for another way."""
