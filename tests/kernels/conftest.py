"""Hypothesis for kernels: no deadline, as the first example compiles; no luck in examples."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("kernels", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("kernels")
