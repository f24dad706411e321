"""A reference stack of four replaceable stages, which drives from sensors and a map alone."""
