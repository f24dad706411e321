"""Messages between vehicles and roadside units: what they say, how they travel, what is kept."""
