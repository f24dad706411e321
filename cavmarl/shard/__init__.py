"""One zone's sub-worlds: vehicles, sensors, and the phases of a tick."""
