"""A page with a picture of a map and marks at its defects."""

from __future__ import annotations

import html
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cavmarl.core.errors import ConfigError
from cavmarl.maps.defects import Defect
from cavmarl.roads.network import RoadNetwork

_COLORS = ("#d62728", "#1f77b4", "#2ca02c", "#ff7f0e", "#9467bd", "#8c564b", "#e377c2")
_WIDTH_PX = 1000
_STYLE = "body{font:14px sans-serif;margin:2em}td,th{text-align:left;padding:2px 12px}"


def write_check_page(path: Path, network: RoadNetwork, defects: Sequence[Defect]) -> None:
    """Write the page; raises ConfigError if the file cannot be written."""
    kinds = list(dict.fromkeys(defect.kind for defect in defects))
    color = {kind: _COLORS[n % len(_COLORS)] for n, kind in enumerate(kinds)}
    min_x, min_y, max_x, max_y = network.extent_m
    wide = max(max_x - min_x, max_y - min_y, 1.0)
    lanes = "".join(
        f'<polyline points="{_points(network, lane)}"/>' for lane in range(len(network.lanes))
    )
    marks = "".join(
        f'<circle cx="{defect.x_m:.1f}" cy="{-defect.y_m:.1f}" r="{wide / 120:.2f}" '
        f'stroke="{color[defect.kind]}"><title>{_tooltip(defect)}</title></circle>'
        for defect in defects
        if np.isfinite(defect.x_m)
    )
    rows = "".join(
        f'<tr><td style="color:{color[defect.kind]}">{html.escape(defect.kind)}</td>'
        f"<td>{html.escape(defect.name)}</td><td>{defect.x_m:.1f}, {defect.y_m:.1f}</td>"
        f"<td>{html.escape(defect.about)}</td></tr>"
        for defect in defects
    )
    box = f"{min_x:.1f} {-max_y:.1f} {max_x - min_x:.1f} {max_y - min_y:.1f}"
    page = (
        f"<!doctype html><meta charset='utf-8'><title>{html.escape(network.name)}</title>"
        f"<style>{_STYLE}</style><h1>{html.escape(network.name)}: {len(defects)} places</h1>"
        f'<svg viewBox="{box}" width="{_WIDTH_PX}"><g fill="none" stroke="#999" '
        f'stroke-width="{wide / 1000:.2f}">{lanes}</g><g fill="none" '
        f'stroke-width="{wide / 300:.2f}">{marks}</g></svg>'
        f"<table><tr><th>kind</th><th>name</th><th>x, y (m)</th><th></th></tr>{rows}</table>"
    )
    try:
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def _points(network: RoadNetwork, lane: int) -> str:
    return " ".join(f"{x:.1f},{-y:.1f}" for x, y, _ in network.lane_polyline(lane).tolist())


def _tooltip(defect: Defect) -> str:
    return html.escape(f"{defect.kind}: {defect.name} {defect.about}")
