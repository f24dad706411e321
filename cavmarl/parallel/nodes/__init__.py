"""Zone nodes: processes that share nothing, each with some zones of the same worlds."""
