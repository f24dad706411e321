"""Exports of maps for other programs: OpenDRIVE, Lanelet2, GeoJSON, left-handed frames."""

from __future__ import annotations
