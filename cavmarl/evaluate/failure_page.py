"""The page of failed trips: a self-contained HTML file."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cavmarl.core.errors import require
from cavmarl.evaluate.failure_clips import CAUSES, REACH_M, Failure, worst
from cavmarl.evaluate.provenance.manifest import write_text
from cavmarl.evaluate.tables import map_outline
from cavmarl.roads.network import RoadNetwork

_HERE = Path(__file__).parent


def write_failures(
    path: Path,
    failures: Sequence[Failure],
    most: int,
    found: int,
    network: RoadNetwork,
    environment: str,
) -> None:
    """Write the worst failures as a page.

    Args:
        path: the file to write.
        failures: the failures that were kept.
        most: number of failures to show.
        found: number of all failures, including failures that were not kept.
        network: the map; lanes far from all failures are left out.
        environment: name for the title.

    Raises:
        MissingExtraError: Jinja2 is not installed.
    """
    jinja2 = require("jinja2", "report")
    chosen = worst(failures, most)
    outline = map_outline(network)
    centers = np.array([failure.trip["center_m"] for failure in chosen]).reshape(-1, 2)
    near = [line for line in outline["lines"] if _is_near(line, centers)]
    data = {
        "causes": CAUSES,
        "reach_m": REACH_M,
        "lane_width_m": outline["lane_width_m"],
        "lines": near,
        "failures": [
            {
                "number": number,
                "cause": failure.cause,
                "severity": round(failure.severity, 2),
                **failure.trip,
                "clip": failure.clip,
            }
            for number, failure in enumerate(chosen)
        ],
    }
    script = (_HERE / "failures.js").read_text(encoding="utf-8")
    style = (_HERE / "failures.css").read_text(encoding="utf-8")
    template = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(
        (_HERE / "failures.html.j2").read_text(encoding="utf-8")
    )
    # A name in the data may contain `</script>`, which must not end the element.
    text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    page = template.render(
        environment=environment,
        found=found,
        shown=len(chosen),
        data=text,
        script=script,
        style=style,
        script_hash=_hash(script),
        style_hash=_hash(style),
    )
    write_text(path, page)


def _is_near(line: list[list[float]], centers: NDArray[np.float64]) -> bool:
    places = np.array(line)
    low, high = places.min(axis=0) - 4.0 * REACH_M, places.max(axis=0) + 4.0 * REACH_M
    return bool(((centers >= low) & (centers <= high)).all(axis=1).any())


def _hash(text: str) -> str:
    """Return the hash by which a content security policy admits an inline element."""
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
