from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from cavmarl.core.errors import ConfigError, MapError
from cavmarl.maps.map_kinds import map_kind
from cavmarl.roads.network import SIGNAL_STATES, VEHICLE_CLASSES, RoadNetwork
from cavmarl.roads.sumo_net.reader import read_network
from tests.support.borders import write_roads

Crossing = Callable[..., Path]


@pytest.fixture
def network(crossing: Crossing) -> RoadNetwork:
    return read_network(crossing())


def lane(network: RoadNetwork, name: str) -> int:
    return network.lane_ids.index(name)


def test_pavements_are_dropped_and_lanes_are_numbered_from_right_to_left(
    network: RoadNetwork,
) -> None:

    assert network.lane_ids[:5] == ("w_1", "w_2", "s_0", "e_0", "n_0")
    assert "w_0" not in network.lane_ids
    assert network.edges["num_lanes"].tolist() == [2, 1, 1, 1, 1, 1, 1, 1]
    assert network.lanes["index"][:2].tolist() == [0, 1]
    assert network.lanes["left"][:2].tolist() == [1, -1]
    assert network.lanes["right"][:2].tolist() == [-1, 0]


def test_permissions_are_bits_of_the_vehicle_classes(network: RoadNetwork) -> None:

    bus = 1 << VEHICLE_CLASSES.index("bus")
    assert network.lanes["permissions"][lane(network, "w_2")] == bus
    assert network.lanes["permissions"][lane(network, "w_1")] == (1 << len(VEHICLE_CLASSES)) - 1


def test_lanes_on_both_sides_of_a_dropped_lane_are_not_neighbours(crossing: Crossing) -> None:
    swapped = ('id="w_1" index="1" speed', 'id="w_1" index="1" allow="bicycle" speed')
    freed = ('id="w_0" index="0" allow="pedestrian"', 'id="w_0" index="0"')
    network = read_network(crossing(swapped, freed))
    assert network.lanes["left"][lane(network, "w_0")] == -1
    assert network.lanes["right"][lane(network, "w_2")] == -1


def test_repeated_points_are_dropped_and_slopes_are_kept(network: RoadNetwork) -> None:

    west = network.lanes[lane(network, "w_1")]
    assert west["num_points"] == 3
    assert west["length_m"] == 95.0
    east = network.lanes[lane(network, "e_0")]
    first = network.points[east["first_point"]]
    assert (first["cos"], first["sin"]) == (1.0, 0.0)
    assert first["slope"] == pytest.approx(0.2)
    assert network.points[east["first_point"] + 1]["z"] == 19.0


def test_a_link_leads_over_its_chain_of_internal_lanes(network: RoadNetwork) -> None:

    turn = network.links[2]
    before, after = lane(network, ":c_2_0"), lane(network, ":c_3_0")
    assert (turn["from_lane"], turn["to_lane"]) == (lane(network, "s_0"), lane(network, "e_0"))
    assert turn["first_internal"] == turn["next_lane"] == before
    assert network.lanes["successor"][before] == after
    assert network.lanes["successor"][after] == lane(network, "e_0")
    assert network.lanes["link"][[before, after]].tolist() == [2, 2]
    assert network.lanes["link_offset_m"][after] == pytest.approx(math.hypot(1, 3))
    assert turn["length_m"] == pytest.approx(math.hypot(1, 3) + math.hypot(4, 2))
    assert chr(turn["direction"]) == "r"
    assert chr(turn["state"]) == "o"


def test_the_lanes_that_lead_into_a_lane_are_listed(network: RoadNetwork) -> None:

    row = network.lanes[lane(network, "e_0")]
    into = network.into[row["first_into"] : row["first_into"] + row["num_into"]]
    assert {network.lane_ids[k] for k in into} == {":c_0_0", ":c_3_0"}
    row = network.lanes[lane(network, ":c_3_0")]
    assert network.into[row["first_into"]] == lane(network, ":c_2_0")
    assert network.lanes["num_into"][lane(network, "w_1")] == 0


def test_bits_of_right_of_way_are_read_from_right_to_left(network: RoadNetwork) -> None:

    owner = np.repeat(np.arange(3), network.links["num_conflicts"])
    pairs = zip(owner, network.conflicts["foe"], network.conflicts["must_yield"], strict=True)
    assert [(int(a), int(b), bool(c)) for a, b, c in pairs] == [
        (0, 1, False),
        (0, 2, False),
        (1, 0, True),
        (2, 0, True),
    ]


def test_crossing_paths_share_the_middle_and_merging_paths_the_end(crossing: Crossing) -> None:
    network = read_network(crossing())
    cross, merge = network.conflicts[0], network.conflicts[1]
    for side in ("", "foe_"):
        assert cross[f"{side}enter_m"] == pytest.approx(5.0 - 2.6, abs=0.5)
        assert cross[f"{side}leave_m"] == pytest.approx(5.0 + 2.6, abs=0.5)
    assert merge["leave_m"] == network.links["length_m"][0]
    assert merge["foe_leave_m"] == network.links["length_m"][2]
    assert 0.0 < merge["enter_m"] < 10.0
    mirrored = network.conflicts[2]
    for end in ("enter_m", "leave_m"):
        assert mirrored[end] == cross[f"foe_{end}"]
        assert mirrored[f"foe_{end}"] == cross[end]


def test_a_path_on_a_bridge_does_not_conflict_with_a_path_below(crossing: Crossing) -> None:
    network = read_network(crossing(('shape="0,-5 0,-5 0,5"', 'shape="0,-5,6 0,5,6"')))
    assert network.conflicts["foe"].tolist() == [2, 0]


def test_foes_whose_paths_never_meet_share_their_closest_points(crossing: Crossing) -> None:
    network = read_network(crossing(('shape="0,-5 0,-5 0,5"', 'shape="0,-5 0,-4"')))
    conflict = network.conflicts[0]
    assert conflict["leave_m"] - conflict["enter_m"] == 2.0
    assert (conflict["foe_enter_m"], conflict["foe_leave_m"]) == (0.0, 1.0)


def test_programs_of_signals_are_read(network: RoadNetwork) -> None:

    assert network.signal_ids == ("c",)
    signal = network.signals[0]
    program = network.programs[signal["program"]]
    assert (program["num_phases"], signal["num_links"]) == (3, 3)
    assert (program["offset_s"], program["cycle_s"]) == (3.0, 60.0)
    letters = "".join(SIGNAL_STATES[code] for code in network.phase_states)
    assert letters == "GrryrrrGg"
    assert network.phases["first_state"].tolist() == [0, 3, 6]
    assert network.links["signal"].tolist() == [0, 0, 0]
    assert network.links["signal_index"].tolist() == [0, 1, 2]
    signals = dict(zip(network.junction_ids, network.junctions["signal"].tolist(), strict=True))
    assert signals == {"c": 0, "W": -1, "S": -1, "E": -1, "N": -1}


def test_internal_lanes_without_length_get_a_length_of_1_cm(crossing: Crossing) -> None:
    network = read_network(crossing(('shape="-5,0 5,0"', 'shape="-5,0 -5,0"')))
    row = network.lanes[lane(network, ":c_0_0")]
    assert row["length_m"] == pytest.approx(0.01)
    point = network.points[row["first_point"]]
    assert (point["cos"], point["sin"]) == pytest.approx((1.0, 0.0))


def test_an_internal_lane_without_length_is_level_even_after_a_slope(crossing: Crossing) -> None:
    climb = ('shape="-100,0 -50,0', 'shape="-100,0,-9 -50,0,-6')
    network = read_network(crossing(climb, ('shape="-5,0 5,0"', 'shape="-5,0 -5,0"')))
    point = network.points[network.lanes[lane(network, ":c_0_0")]["first_point"]]
    assert point["slope"] == 0.0


def test_connections_for_bicycles_only_are_dropped(crossing: Crossing) -> None:
    cyclists = ('from="s" to="n"', 'allow="bicycle" from="s" to="n"')
    network = read_network(crossing(cyclists))
    assert network.links["index"].tolist() == [0, 2]
    assert ":c_1_0" not in network.lane_ids
    assert network.conflicts["foe"].tolist() == [1, 0]


def test_links_without_internal_lanes_lead_directly_to_their_target(crossing: Crossing) -> None:
    vias = [(f' via=":c_{k}_0"', "") for k in range(4)]
    network = read_network(crossing(*vias))
    assert not network.edges["internal"].any()
    assert network.links["first_internal"].tolist() == [-1, -1, -1]
    assert network.links["next_lane"].tolist() == network.links["to_lane"].tolist()
    assert (network.conflicts["leave_m"] == 0.0).all()
    assert len(network.conflicts) == 4


def test_gzip_and_plain_files_have_the_same_content_hash(crossing: Crossing) -> None:
    plain = crossing()
    packed = plain.with_name("crossing.net.xml.gz")
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    one, other = read_network(plain), read_network(packed)
    assert one.content_hash == other.content_hash
    assert one.name == other.name == "crossing"
    assert one.source_hash != other.source_hash


def test_arrays_cannot_be_written(network: RoadNetwork) -> None:

    with pytest.raises(ValueError, match="read-only"):
        network.lanes["speed_mps"][0] = 1.0
    with pytest.raises(ValueError, match="read-only"):
        network.into[0] = 0


BROKEN = {
    "speed NaN": ('id="s_0" index="0" speed="10"', 'id="s_0" index="0" speed="nan"', "s_0.*speed"),
    "speed infinite": (
        'id="s_0" index="0" speed="10"',
        'id="s_0" index="0" speed="inf"',
        "s_0.*inf",
    ),
    "speed negative": (
        'id="s_0" index="0" speed="10"',
        'id="s_0" index="0" speed="-1"',
        "positive",
    ),
    "coordinate NaN": ('shape="0,-100 0,-5"', 'shape="0,nan 0,-5"', "line .*s_0.*0,nan"),
    "coordinate missing": ('shape="0,-100 0,-5"', 'shape="0 0,-5"', "s_0.*point '0'"),
    "no shape": ('shape="0,-100 0,-5"', 'shape=""', "no shape"),
    "zero-length lane": ('shape="0,-100 0,-5"', 'shape="0,-5 0,-5"', "s_0.*no length"),
    "duplicate edge": ('<edge id="s" from', '<edge id="w" from', '<edge id="w"> occurs twice'),
    "duplicate junction": ('junction id="S"', 'junction id="W"', "occurs twice"),
    "missing attribute": ('type="traffic_light" ', "", "junction.*no attribute 'type'"),
    "unknown edge": ('from="s" to="n"', 'from="s" to="x"', "connection.*'x'"),
    "unknown via": ('via=":c_1_0"', 'via=":c_9_0"', ":c_9_0.*missing"),
    "shared internal lane": ('via=":c_1_0"', 'via=":c_0_0"', "two connections"),
    "lane order": ('id="w_2" index="2"', 'id="w_3" index="3"', "w_3.*must be 'w_2'"),
    "letters": ('state="yrr"', 'state="yr"', "different numbers of links"),
    "unknown letter": ('state="yrr"', 'state="yrQ"', "Q"),
    "no cycle": ('duration="', 'duration="0" was="', "without duration"),
    "link out of signal": ('linkIndex="2"', 'linkIndex="7"', "no state for link 7"),
    "no program": ('<tlLogic id="c"', '<tlLogic id="d"', "'c' controls .* no program"),
    "lane of elsewhere": (
        'incLanes="w_1 s_0"',
        'incLanes="w_1 e_0"',
        "'e_0', which ends elsewhere",
    ),
    "bits": ('foes="110"', 'foes="1x0"', "request.*foes"),
    "too few bits": ('foes="110"', 'foes="1"', "'c' has more links than its 3 requests"),
    "unclosed": ("</net>", "", "line .*broken XML"),
    "not a net": ("<net ", "<map ", "broken XML|not the root"),
    "nothing to drive": (
        "<lane ",
        '<lane allow="pedestrian" was="" ',
        "duplicate attribute|no lane",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_the_error_for_a_broken_map_names_the_file_and_the_fault(
    crossing: Crossing, case: str
) -> None:
    old, new, message = BROKEN[case]
    path = crossing((old, new))
    with pytest.raises(MapError, match=message) as caught:
        read_network(path)
    assert str(caught.value).startswith(str(path))
    assert ":" in str(caught.value)


def test_files_with_xml_entities_are_refused(tmp_path: Path) -> None:
    bomb = '<!DOCTYPE n [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><net version="1.20">&b;</net>'
    leak = '<!DOCTYPE n [<!ENTITY a SYSTEM "file:///etc/hostname">]><net version="1.20">&a;</net>'
    for text in (bomb, leak):
        path = tmp_path / "hostile.net.xml"
        path.write_text(text)
        with pytest.raises(MapError, match="document type or entities"):
            read_network(path)


def test_truncated_gzip_and_missing_files_are_refused(crossing: Crossing, tmp_path: Path) -> None:
    packed = tmp_path / "half.net.xml.gz"
    packed.write_bytes(gzip.compress(crossing().read_bytes())[:200])
    with pytest.raises(MapError, match="broken gzip"):
        read_network(packed)
    with pytest.raises(MapError, match="No such file"):
        read_network(tmp_path / "none.net.xml")
    with pytest.raises(MapError, match="directory"):
        read_network(tmp_path)


def test_the_size_of_a_file_is_limited(crossing: Crossing, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cavmarl.roads.sumo_net.xml_source.MAX_XML_BYTES", 100)
    with pytest.raises(MapError, match="larger than 100 bytes"):
        read_network(crossing())


def test_the_compression_ratio_of_a_gzip_file_is_limited(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packed = tmp_path / "bomb.net.xml.gz"
    packed.write_bytes(gzip.compress(b'<net version="1.20">' + b" " * 20_000_000 + b"</net>"))
    with pytest.raises(MapError, match=r"larger than 16777216 bytes.*set CAVMARL_MAX_XML_RATIO"):
        read_network(packed)
    monkeypatch.setenv("CAVMARL_MAX_XML_RATIO", "2000")
    with pytest.raises(MapError, match="no lane"):
        read_network(packed)


def test_deeply_nested_elements_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for kind, name in (("net", "deep.net.xml"), ("osm", "deep.osm")):
        deep = tmp_path / name
        deep.write_text(f"<{kind}>{'<a>' * 120}{'</a>' * 120}</{kind}>")
        with pytest.raises(MapError, match=r"over 100 deep: .*set CAVMARL_MAX_XML_DEPTH"):
            map_kind(deep)
    monkeypatch.setenv("CAVMARL_MAX_XML_DEPTH", "121")
    assert map_kind(deep) == "osm"


def test_the_number_of_points_of_a_lane_is_limited(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = crossing()
    monkeypatch.setenv("CAVMARL_MAX_LANE_POINTS", "1")
    with pytest.raises(
        MapError,
        match=r"line \d+: <lane .* points, more than 1 \(environment variable CAVMARL_MAX_LANE",
    ):
        read_network(path)
    monkeypatch.setenv("CAVMARL_MAX_LANE_POINTS", "none")
    with pytest.raises(ConfigError, match="CAVMARL_MAX_LANE_POINTS = 'none': must be a whole"):
        read_network(path)


@pytest.mark.parametrize(
    ("name", "before"), [("edge", '<edge id="w" '), ("junction", 'id="E" type="dead_end" ')]
)
def test_the_number_of_points_of_edges_and_junctions_is_limited(
    crossing: Crossing, name: str, before: str
) -> None:
    many = f'shape="{" ".join(["0,0"] * 100_001)}"'
    path = crossing((' shape=""/>', "/>"), (before, f"{before}{many} "))
    with pytest.raises(MapError, match=rf"line \d+: <{name} .* 100001 points, more than 100000"):
        read_network(path)


@pytest.mark.parametrize("coordinate", ["2e8", "-1e300"])
def test_coordinates_beyond_100_000_km_are_refused(crossing: Crossing, coordinate: str) -> None:
    path = crossing(('shape="5,0,0 ', f'shape="{coordinate},0,0 '))
    with pytest.raises(MapError, match=rf"<lane .* the point '{coordinate},.*', beyond 1e\+08 m"):
        read_network(path)


def test_the_length_of_a_path_over_a_junction_is_limited(
    crossing: Crossing, monkeypatch: pytest.MonkeyPatch
) -> None:
    far = crossing(('shape="5,0,0 ', 'shape="9005,0,0 '))
    with pytest.raises(
        MapError, match=r"from lane 'w_1' to lane 'e_0' is .* m long over the junction, more than"
    ):
        read_network(far)
    monkeypatch.setenv("CAVMARL_MAX_CROSSING_M", "1")
    with pytest.raises(
        MapError,
        match=r"more than 1 \(environment variable CAVMARL_MAX_CROSSING_M\): repair the shapes",
    ):
        read_network(crossing())


def test_the_extent_of_a_map_ignores_nodes_without_roads(tmp_path: Path) -> None:
    path = write_roads(tmp_path / "road.net.xml", [((0.0, 0.0), (100.0, 50.0))], 10.0)
    stray = '<junction id="far" type="dead_end" x="0" y="-9000" incLanes="" intLanes="" shape=""/>'
    text = path.read_text().replace('Boundary="0.0,0.0', 'Boundary="0.0,-9000.0')
    path.write_text(text.replace("</net>", f"{stray}</net>"))
    assert 'convBoundary="0.0,-9000.0,100.0,50.0"' in path.read_text()
    assert read_network(path).extent_m == pytest.approx((0.0, 0.0, 100.0, 50.0), abs=5.0)
