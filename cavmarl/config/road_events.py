"""The key `map.events`: roads that close, open, slow down or change direction during an episode.

map:
  source: grid4x4
  changed_lanes: 8
  events:
    - {at_s: 60, action: close, edges: [B1B2, B2B1]}
    - {at_s: 90, action: damage, edges: [A1B1], speed_mps: 3}
    - {at_s: 300, action: open, edges: [B1B2, B2B1]}
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

from cavmarl.config.checks import Within, check, check_ranges


@dataclass(frozen=True, kw_only=True)
class RoadEvent:
    """An event in all worlds. It takes effect in the first step that begins at or after its time.

    Attributes:
        at_s: time since the beginning of the episode.
        action: `close`, `open` (restore the map's state), `damage` (a lower speed limit), or
            `reverse` (one of `map.contraflow`).
        edges: ids of the roads.
        lanes: indices of the lanes, from the kerb; default: all.
        speed_mps: the limit of damaged roads.
        shuts_in: whether a closed or reversed road may be the last way out of other roads.
    """

    at_s: Annotated[float, Within(0.0, 1e6)]
    action: Literal["close", "open", "damage", "reverse"]
    edges: tuple[str, ...]
    lanes: tuple[int, ...] | None = None
    speed_mps: Annotated[float, Within(0.01, 100.0)] | None = None
    shuts_in: bool = False


def check_events(events: Sequence[RoadEvent], contraflow: Sequence[str]) -> None:
    """Check the values of each event. Raises ConfigError."""
    for k, event in enumerate(events):
        key = f"map.events.{k}"
        check_ranges(key, event)
        check(bool(event.edges), f"{key}.edges", event.edges, "must name a road")
        check(
            (event.speed_mps is not None) == (event.action == "damage"),
            f"{key}.speed_mps",
            event.speed_mps,
            "must be given for damage, and for no other action",
        )
        others = [edge for edge in event.edges if edge not in contraflow]
        check(
            event.action != "reverse" or not others,
            f"{key}.edges",
            event.edges,
            f"only roads in map.contraflow can be reversed; add {', '.join(others)} there",
        )
        check(
            event.action != "reverse" or event.lanes is None,
            f"{key}.lanes",
            event.lanes,
            "a road is reversed with all its lanes; leave the key out",
        )
