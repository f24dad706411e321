"""Compiled terms and sums of the reward."""
