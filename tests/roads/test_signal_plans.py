"""Signal programs of additional files: as in SUMO, the program that is read last is active."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import pytest

from cavmarl.core.errors import MapError
from cavmarl.maps.check import check_map
from cavmarl.roads.kernels.signal_phases import detect, switch_signals
from cavmarl.roads.network import SIGNAL_STATES, RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from cavmarl.roads.sumo_net.signal_plans import with_outages, with_programs
from cavmarl.shards.shard import make_worlds
from tests.support.traffic import on_lane

NIGHT = """<additional>
  <inductionLoop id="passed over" lane="s_0" pos="1" period="60" file="x"/>
  <tlLogic id="c" type="static" programID="night" offset="begin">
    <phase duration="5" state="Grr"/>
    <phase duration="5" state="rGG"/>
  </tlLogic>
  EXTRA
</additional>
"""
WEEK = """
  <WAUT id="week" refTime="0" startProg="0">
    <wautSwitch time="00:00:40" to="night"/><wautSwitch time="60" to="off"/>
  </WAUT>
  <wautJunction wautID="week" junctionID="c"/>
"""


@pytest.fixture
def additional(tmp_path: Path) -> Callable[..., Path]:
    def write(extra: str = "", *changes: tuple[str, str]) -> Path:
        text = NIGHT.replace("EXTRA", extra)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        path = tmp_path / "programs.add.xml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def states(
    network: RoadNetwork, ticks: Iterable[int], dt: float = 1.0, stands_m: float | None = None
) -> list[str]:
    """Return the shown states at these ticks; with `stands_m`, a car stands on the main road."""
    worlds = make_worlds(1, 1, network)
    if stands_m is not None:
        worlds.rows[0, 0] = on_lane(network, network.lane_ids.index("w_1"), stands_m)[0]
        worlds.num_owned[0] = 1
    shown = []
    for tick in ticks:
        worlds.ticks[0] = tick
        detect(
            network.arrays.lane_place,
            network.arrays.places,
            worlds.rows,
            worlds.num_owned,
            worlds.ticks,
            dt,
            worlds.detected_s,
        )
        switch_signals(
            network.arrays,
            worlds.keys,
            worlds.ticks,
            worlds.detected_s,
            dt,
            worlds.controllers,
            worlds.signal_phase,
        )
        first = network.phases[worlds.signal_phase[0, 0]]["first_state"]
        codes = network.phase_states[first : first + 3]
        shown.append("".join(SIGNAL_STATES[code] for code in codes))
    return shown


def test_the_program_loaded_last_is_active(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    plain = read_network(crossing())
    network = with_programs(plain, [additional()])
    assert network.program_ids == ("0", "night")
    assert states(network, [0, 4, 5, 9, 10]) == ["Grr", "Grr", "rGG", "rGG", "Grr"]
    assert plain.program_ids == ("0",), "the argument was changed"
    assert network.content_hash != plain.content_hash
    assert network.source_hash != plain.source_hash
    assert with_programs(plain) is plain


def test_phases_change_at_the_exact_tick_despite_rounding(
    crossing: Callable[..., Path],
) -> None:
    durations = ("0.7", "0.4", "1.9")
    changes = zip(('duration="30"', 'duration="4"', 'duration="26"'), durations, strict=True)
    network = read_network(
        crossing(*((old, f'duration="{new}"') for old, new in changes), ('offset="3"', ""))
    )
    first, second, third = map(Fraction, durations)

    def planned(tick: int) -> str:
        left = Fraction(tick, 10) % (first + second + third)
        return "Grr" if left < first else "yrr" if left < first + second else "rGg"

    assert states(network, range(600), 0.1) == [planned(tick) for tick in range(600)]


def test_the_last_of_several_programs_in_a_map_is_active(crossing: Callable[..., Path]) -> None:
    second = (
        '<tlLogic id="c" type="static" programID="1"><phase duration="9" state="ggg"/></tlLogic>'
    )
    network = read_network(crossing(("</tlLogic>", f"</tlLogic>{second}")))
    assert network.program_ids == ("0", "1")
    assert states(network, [0, 7]) == ["ggg", "ggg"]


def test_a_selected_program_overrides_all_others(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    plain = read_network(crossing())
    assert states(with_programs(plain, [additional(WEEK)], {"c": "0"}), [3, 45, 70]) == [
        "Grr",
        "rGg",
        "Grr",
    ]
    assert states(with_programs(plain, chosen={"c": "off"}), [0, 50]) == ["Ooo", "Ooo"]


def test_a_signal_with_an_outage_goes_dark_and_stays_dark(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    plain = read_network(crossing())
    dark = with_outages(plain, {"c": 4.0})
    assert states(dark, [3, 4, 5, 500]) == [*states(plain, [3]), "Ooo", "Ooo", "Ooo"]
    assert states(with_outages(plain, {"c": 0.0}), [0]) == ["Ooo"]
    assert dark.source_hash not in (plain.source_hash, with_outages(plain, {"c": 5.0}).source_hash)
    timed = with_programs(plain, [additional(WEEK)])
    assert states(with_outages(timed, {"c": 50.0}), [45, 50, 55, 70]) == [
        *states(timed, [45]), "Ooo", "Ooo", "Ooo",
    ]  # fmt: skip
    with pytest.raises(MapError, match="this map has no signal 'd'"):
        with_outages(plain, {"d": 4.0})


def test_a_timetable_switches_programs(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    network = with_programs(read_network(crossing()), [additional(WEEK)])
    expected = ["rGg", "Grr", "rGg", "Grr", "rGG", "Ooo", "Ooo"]
    assert states(network, [0, 3, 39, 40, 45, 60, 99]) == expected


def test_states_beyond_the_links_have_no_effect(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    """SUMO accepts such programs with a warning."""
    longer = additional("", ('state="Grr"', 'state="GrrGG"'), ('state="rGG"', 'state="rGGrr"'))
    network = with_programs(read_network(crossing()), [longer])
    assert states(network, [0, 5, 10]) == ["Grr", "rGG", "Grr"]


def test_a_program_may_have_fewer_states_than_another_but_not_than_links(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    longer = (('state="Grr"', 'state="Grrr"'), ('state="yrr"', 'state="yrrr"'),
              ('state="rGg"', 'state="rGgr"'))  # fmt: skip
    network = with_programs(read_network(crossing(*longer)), [additional()])
    assert states(network, [0, 5, 10]) == ["Grr", "rGG", "Grr"]
    shorter = additional("", ('state="Grr"', 'state="Gr"'), ('state="rGG"', 'state="rG"'))
    with pytest.raises(MapError, match="program 'night' with 2 states for 3 links"):
        with_programs(read_network(crossing()), [shorter])


def test_a_program_without_a_name_gets_the_same_name_as_in_sumo(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    unnamed = additional("", (' programID="night"', ""))
    assert with_programs(read_network(crossing()), [unnamed]).program_ids == ("0", "<unknown>")


def test_an_element_without_phases_changes_the_offset_of_a_program(
    crossing: Callable[..., Path], additional: Callable[..., Path]
) -> None:
    plain = read_network(crossing())
    path = additional()
    path.write_text('<additional><tlLogic id="c" programID="0" offset="5"/></additional>')
    network = with_programs(plain, [path])
    assert network.program_ids == ("0",)
    assert states(network, range(2, 90)) == states(plain, range(88))


BROKEN = {
    "no id": ("", (' id="c"', ""), "has no attribute 'id'"),
    "empty id": ("", ('id="c"', 'id=""'), "has an empty id"),
    "no type": ("", ('type="static" ', ""), "a program 'night' without type"),
    "other map": ("", ('id="c"', 'id="z"'), "line 3: .*no signal 'z'.*is for this map"),
    "letters": ("", ('state="rGG"', 'state="rG"'), "different numbers of links"),
    "name taken": ("", ('programID="night"', 'programID="0"'), "two programs '0'"),
    "no duration": ("", ('<phase duration="5"', "<phase"), "line 4: <phase> has no attribute"),
    "no number": ("", ('duration="5"', 'duration="inf"'), "duration='inf'"),
    "no phase": ("", ('state="Grr"', 'state="Grr" next="7"'), "leads to the missing phase 7"),
    "unknown program": (WEEK, ('to="night"', 'to="day"'), "no program 'day'; use one of 0, night"),
    "unknown timetable": (WEEK, ('wautID="week"', 'wautID="year"'), "unknown WAUT 'year'"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_programs_are_refused(
    crossing: Callable[..., Path], additional: Callable[..., Path], case: str
) -> None:
    extra, change, message = BROKEN[case]
    with pytest.raises(MapError, match=message):
        with_programs(read_network(crossing()), [additional(extra, change)])


def test_a_detector_of_an_actuated_program_is_2_s_before_the_end_of_the_lane(
    crossing: Callable[..., Path],
) -> None:
    text = ('type="static" programID="0" offset="3"', 'type="actuated" programID="0" offset="3"')
    green = ('duration="30"', 'duration="30" minDur="5" maxDur="50"')
    network = read_network(crossing(text, green))
    # 95 m - 2 s * 10 m/s. The queue that can drive off in 5 s of green is longer than 20 m.
    assert network.detectors["s_m"].tolist() == [75.0]
    assert [network.lane_ids[row] for row in network.detectors["lane"]] == ["w_1"]
    assert network.phases["num_detectors"].tolist() == [1, 0, 0]
    assert network.phases["green"].tolist() == [True, False, True]
    assert check_map(network).actuated_signals == 1
    assert network.phase_detectors.tolist() == [0]


def test_an_actuated_green_ends_at_its_maximum_duration_to_the_millisecond(
    crossing: Callable[..., Path],
) -> None:
    text = ('type="static" programID="0" offset="3"', 'type="actuated" programID="0" offset="0"')
    green = ('duration="30"', 'duration="30" minDur="5" maxDur="12.5"')
    network = read_network(crossing(text, green))
    ticks = [*range(0, 12_400, 100), *range(12_400, 12_510)]
    shown = states(network, ticks, 0.001, stands_m=75.0)
    assert ticks[shown.index("yrr")] == 12_500
    assert ticks[states(network, ticks, 0.001).index("yrr")] == 5_000, (
        "without a vehicle, the green lasted longer than its minimum"
    )


@pytest.mark.parametrize(
    ("change", "simplified"),
    [
        (('type="static"', 'type="actuated"'), False),
        (('type="static"', 'type="delay_based"'), True),
        (('type="static"', 'type="NEMA"'), True),
        (('state="Grr"', 'state="Grr" next="1 2"'), True),
    ],
)
def test_unsupported_rules_are_reported(
    crossing: Callable[..., Path], change: tuple[str, str], simplified: bool
) -> None:
    report = check_map(read_network(crossing(change)))
    assert report.programs_simplified == (("c/0",) if simplified else ())
    assert any("programs simplified" in note for note in report.notes) == simplified
