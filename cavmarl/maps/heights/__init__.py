"""Heights of a map: terrain models are read and draped over a network continuously."""

from __future__ import annotations
