"""Compiled copies between replicas of shared arrays."""
