"""Comparison of a map or a cloud with a measured point cloud: alignment, distances, road edges.

Builds on the rest of `maps`.
"""
