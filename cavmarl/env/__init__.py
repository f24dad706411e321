"""Environments: the PettingZoo environment, the vector environment, actions, and registration.

Builds on `parallel`; used by `policies`, `adapters` and `evaluate`.
"""
