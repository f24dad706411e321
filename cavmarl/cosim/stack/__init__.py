"""A reference driving stack with replaceable stages; it uses only sensors and a map."""
