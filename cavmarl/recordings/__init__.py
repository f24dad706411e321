"""Recordings of runs: writing frames to Parquet files during a run, reading and exporting them.

`env` writes recordings, and the command line replays them. The package uses frames
(`engine.world_frame`) only, not worlds.
"""
