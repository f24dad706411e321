"""Hypothesis for kernels: the first example compiles, so no deadline; the same examples each run."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("kernels", deadline=None, max_examples=3000)
settings.load_profile("kernels")
