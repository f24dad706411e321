"""Heights of a map: reads terrain models, and gives networks heights without vertical jumps."""

from __future__ import annotations
