"""Traffic: departures, routes, and the seeded generator of traffic."""
