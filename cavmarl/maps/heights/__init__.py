"""Heights of a map: reads terrain models, and drapes networks over them without steps."""

from __future__ import annotations
