"""Which worker or node runs which worlds and zones, how they move, and commands to the workers."""
