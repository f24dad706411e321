"""Rendering of worlds: frames, windows, videos.

The renderer reads the engine's vehicle rows; `env` and `evaluate` use the renderer.
"""
