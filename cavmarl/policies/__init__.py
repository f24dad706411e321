"""Drivers for agents' vehicles, and the networks that trained ones need.

Stands on `env`.
"""
