"""Drivers for agents' vehicles, and the networks that trained drivers evaluate.

Depends on `env`.
"""
