"""The phases of a tick, over many worlds and over the zones of one process."""
