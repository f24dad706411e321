"""The zones of one world on several machines."""
