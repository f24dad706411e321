"""Pictures of worlds: frames, windows, videos."""
