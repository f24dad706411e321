"""Heights of a map: reads terrain models, and gives networks their heights without steps."""

from __future__ import annotations
