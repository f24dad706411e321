"""Rendering of worlds: frames, windows, videos.

The renderer reads rows of the engine; `env` and `evaluate` use it.
"""
