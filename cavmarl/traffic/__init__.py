"""Who drives where: departures and the seeded generator."""
