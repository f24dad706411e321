"""Configuration of a world: the keys of `env.yaml`, their checks, and the entries of `envs/`.

Builds on `core` alone; all other folders read it.
"""
