"""Partitions of maps into zones: layouts, the zone file, halos, statistics."""
