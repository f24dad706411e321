"""Pictures of worlds: frames, windows, videos.

Reads the engine's rows; `env` and `evaluate` draw with it.
"""
