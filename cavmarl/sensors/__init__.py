"""What agents observe, and what their vehicles carry.

Kernels beside them; `shards` senses in each step.
"""
