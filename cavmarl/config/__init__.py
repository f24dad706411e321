"""What a world is: the keys of `env.yaml`, their checks, and the entries of `envs/`.

Stands on `core` alone; all other folders read it.
"""
