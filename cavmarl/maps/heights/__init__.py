"""Heights of a map: models of the ground read, laid under a network, kept continuous."""

from __future__ import annotations
