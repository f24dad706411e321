"""Recordings of runs: frames written to Parquet files during a run, read again, and exported.

`env` writes recordings, and the command line replays them. The package uses frames
(`engine.world_frame`) only, not worlds.
"""
