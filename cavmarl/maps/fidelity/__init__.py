"""How true a map or a cloud is to a measured point cloud: alignment, distances, road edges.

Stands on the rest of `maps`.
"""
