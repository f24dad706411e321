"""The assignment of shards to workers: load scores, costs of shards, plans.

Pure arithmetic; `parallel` measures the inputs and carries out the plans.
"""
