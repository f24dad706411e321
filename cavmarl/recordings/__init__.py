"""Recordings of runs: frames into Parquet files while a run goes on, read again, exported.

`env` records with it, the command line replays; it takes frames
(`engine.world_frame`) and knows no world.
"""
