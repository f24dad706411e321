"""Plans of faults: what stands in them, what is refused, and that the page says it."""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from cavmarl import make_vec
from cavmarl.core.errors import ConfigError
from cavmarl.handoff.fault_injection.fault_plan import (
    COORDINATOR_POINTS,
    MESSAGES,
    ZONE_POINTS,
    Crash,
    Faults,
    read_faults,
)
from cavmarl.ownership.transport import Rates
from tests.support.generated import check_block, table

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "faults.md"
EXAMPLE = ROOT / "examples" / "faults.json"


def test_a_plan_goes_to_json_and_back() -> None:
    faults = Faults(
        seed=3,
        messages={"Ack": Rates(drop=0.5, longest_delay=3)},
        crashes=(Crash(4, "advance", 1, True, 2), Crash(5, "BEGIN torn")),
        crash_rate=0.01,
        until=9,
    )
    assert read_faults(faults.to_json()) == faults
    assert read_faults("{}") == Faults()
    assert not Faults().may_crash


def test_the_example_is_a_plan() -> None:
    faults = read_faults(str(EXAMPLE))
    assert faults.may_crash
    assert faults.messages


CRASH: dict[str, Any] = {"tick": 1, "point": "advance", "zone": 0}
REFUSED: list[tuple[Any, str]] = [
    ("{", "faults: no JSON"),
    ("{'seed': 1}", "faults: no JSON"),
    ({"sed": 1}, "faults: no key sed; there are seed, messages"),
    ({"seed": -1}, "faults: seed is -1: must be a whole number, 0 or more"),
    ({"seed": 1.5}, "faults: seed is 1.5"),
    ({"messages": []}, "faults, messages: must be an object"),
    ({"messages": {"Prepared": {}}}, r"messages \['Prepared'\] are none of Step, Done, Prepare"),
    ({"messages": {"Ack": 0.5}}, "faults, messages, Ack: must be an object of drop"),
    ({"messages": {"Ack": {"lose": 0.5}}}, "faults, messages, Ack: no key lose"),
    ({"messages": {"Ack": {"drop": 1.5}}}, "Ack: the rate of drop is 1.5: must be a number from 0"),
    ({"messages": {"Ack": {"drop": -0.1}}}, "the rate of drop is -0.1"),
    ({"messages": {"Ack": {"drop": "all"}}}, "the rate of drop is 'all'"),
    ({"messages": {"Ack": {"drop": True}}}, "the rate of drop is True"),
    ('{"messages": {"Ack": {"drop": NaN}}}', "the rate of drop is nan"),
    ({"messages": {"Ack": {"longest_delay": 0}}}, "longest_delay is 0: must be a whole number, 1"),
    ({"messages": {"Step": {"drop": 1.0}}}, "Step has to arrive now and then"),
    ({"messages": {"Done": {"drop": 0.5, "corrupt": 0.5}}}, "Done has to arrive now and then"),
    ({"crash_rate": 0.2}, "crash_rate is 0.2: must be a number from 0 to 0.1"),
    ({"until": -1}, "until is -1"),
    ({"until": 3, "crashes": [CRASH | {"tick": 3}]}, "dies in tick 3, and nothing happens from"),
    ({"crashes": {}}, "faults, crashes: must be a list"),
    ({"crashes": [7]}, r"faults, crashes\[0\]: must be an object of tick, point"),
    ({"crashes": [CRASH, {"tick": 3}]}, r"faults, crashes\[1\]: needs point"),
    ({"crashes": [CRASH | {"when": 3}]}, r"faults, crashes\[0\]: no key when"),
    ({"crashes": [CRASH | {"point": "lunch"}]}, "a zone cannot die at 'lunch'; points are PREPARE"),
    ({"crashes": [{"tick": 1, "point": "ACK sent"}]}, "the coordinator cannot die at 'ACK sent'"),
    ({"crashes": [CRASH | {"zone": -1}]}, "the zone of a crash is -1"),
    ({"crashes": [CRASH | {"tick": -1}]}, "the tick of a crash is -1"),
    ({"crashes": [CRASH | {"times": 0}]}, "times of a crash is 0"),
    ({"crashes": [CRASH | {"lives_on": 1}]}, "lives_on = 1: must be true or false"),
]


@pytest.mark.parametrize(("plan", "message"), REFUSED)
def test_at13_what_cannot_be_is_named_with_its_place(plan: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read_faults(plan if isinstance(plan, str) else json.dumps(plan))


def test_at13_a_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    with pytest.raises(ConfigError, match=r"plan\.json: No such file.*; name a file of JSON"):
        read_faults(str(path))
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"plan\.json: .*name a file of JSON"):
        read_faults(str(path))
    path.write_text("[]")
    with pytest.raises(ConfigError, match=r"plan\.json: must be an object"):
        read_faults(str(path))


def test_at13_worlds_that_cannot_be_harmed_so(tmp_path: Path) -> None:
    def build(faults: Faults, worlds: int = 1) -> None:
        overrides = {"zones.faults": faults.to_json()}
        make_vec("merge", num_envs=worlds, zones=2, overrides=overrides)

    with pytest.raises(ConfigError, match="hosts die in one world at a time, not in 2"):
        build(Faults(crash_rate=0.01), worlds=2)
    with pytest.raises(ConfigError, match="zone 2 cannot die, there are 2 zones; name one from 0"):
        build(Faults(crashes=(Crash(1, "advance", 2),)))
    build(Faults(messages={"Ack": Rates(drop=0.5)}), worlds=2)


def meanings(kind: type[Any]) -> list[tuple[str, str, str]]:
    """Of each key what it is when it is left out, and what its docstring says."""
    text = " ".join((kind.__doc__ or "").split("Attributes:")[1].split("Raises:")[0].split())
    names = [entry.name for entry in fields(kind)]
    rows = []
    for entry, following in zip(fields(kind), [*names[1:], None], strict=True):
        start = text.index(f"{entry.name}: ") + len(entry.name) + 2
        end = text.index(f" {following}: ", start) if following else len(text)
        plain = isinstance(entry.default, int | float | None)
        default = json.dumps(entry.default) if plain else "must be there"
        rows.append((f"`{entry.name}`", default, text[start:end]))
    return rows


@pytest.mark.parametrize(("name", "kind"), [("rates", Rates), ("crashes", Crash)])
def test_the_page_says_what_stands_in_a_plan(name: str, kind: type[Any]) -> None:
    check_block(PAGE, name, table(("key", "left out", "meaning"), meanings(kind)))


def test_the_page_says_who_can_die_where() -> None:
    points = list(dict.fromkeys((*ZONE_POINTS, *COORDINATOR_POINTS)))
    rows = [
        (
            f"`{point}`",
            "x" if point in ZONE_POINTS else "",
            "x" if point in COORDINATOR_POINTS else "",
        )
        for point in points
    ]
    check_block(PAGE, "points", table(("point", "a zone's host", "the coordinator"), rows))


def test_the_page_names_every_kind_of_message() -> None:
    check_block(PAGE, "kinds", ", ".join(f"`{kind}`" for kind in MESSAGES))


def test_the_page_shows_the_example() -> None:
    check_block(PAGE, "example", f"```json\n{EXAMPLE.read_text(encoding='utf-8').strip()}\n```")
