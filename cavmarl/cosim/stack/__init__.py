"""A reference stack of replaceable stages that drives by sensors and a map alone."""
