"""What agents observe, and what their vehicles carry: one file a sensor.

Kernels beside them; `shards` senses in each step.
"""
