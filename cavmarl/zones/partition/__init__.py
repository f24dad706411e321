"""Maps cut into zones: layouts, the zone file, halos, statistics."""
