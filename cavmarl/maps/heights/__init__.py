"""Heights of a map: terrain models are read, and networks get their heights without steps."""

from __future__ import annotations
