"""The terms, as compiled functions of a vehicle and its surroundings."""
