"""Comparison of traffic with SUMO by the same metrics."""
