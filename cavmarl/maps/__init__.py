"""Map files: built into SUMO networks, and checked."""
