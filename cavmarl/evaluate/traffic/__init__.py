"""Our traffic beside SUMO's, measured by one meter."""
