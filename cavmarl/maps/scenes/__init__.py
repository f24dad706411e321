"""Logged scenes of data sets: ScenarioNet's pickles and the JSON files of GPUDrive.

A scene has lanes, from which a SUMO network is built, and tracks of road users.
"""
