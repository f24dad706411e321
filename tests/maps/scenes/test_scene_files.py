"""Reading scene files of ScenarioNet and GPUDrive: content, ignored parts and refusals."""

from __future__ import annotations

import os
import pickle
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl import MapError
from cavmarl.maps.scenes.scene_files import read_scene
from cavmarl.maps.scenes.scene_pickle import unpickle
from tests.support.logged_scenes import TIMES, gpudrive, scenario, write_json_scene, write_pickle

Change = Callable[[dict[str, Any]], object]


def test_both_formats_give_the_same_tracks(tmp_path: Path) -> None:
    one, other = read_scene(write_pickle(tmp_path)), read_scene(write_json_scene(tmp_path))
    assert (one.step_s, one.num_times, one.own, one.present) == (0.1, TIMES, "7", 10)
    assert (other.step_s, other.num_times, other.own) == (0.1, TIMES, "0")
    for mine, theirs in zip(one.tracks, other.tracks, strict=True):
        assert mine.kind == theirs.kind
        assert (mine.valid == theirs.valid).all()
        assert mine.poses == pytest.approx(theirs.poses, abs=1e-6)
        assert mine.size_m == pytest.approx(theirs.size_m)
    assert len(one.lanes) == len(other.lanes) == 20
    assert len(one.road_edges) == len(other.road_edges) == 4
    assert one.lanes[0].speed_mps == pytest.approx(50.0 / 3.6)
    assert other.lanes[0].speed_mps is None
    assert one.notes == ("1 road lines ignored",)


def test_headings_in_degrees_are_recognized_from_the_motion_of_vehicles(tmp_path: Path) -> None:
    radians = read_scene(write_json_scene(tmp_path))
    degrees = read_scene(write_json_scene(tmp_path, gpudrive(in_degrees=True)))
    for mine, theirs in zip(radians.tracks, degrees.tracks, strict=True):
        assert mine.poses == pytest.approx(theirs.poses, abs=1e-5)
    assert any("degrees" in note for note in degrees.notes)
    assert not any("degrees" in note for note in radians.notes)


@pytest.mark.parametrize("protocol", range(2, pickle.HIGHEST_PROTOCOL + 1))
def test_every_protocol_of_pickles_is_read(protocol: int) -> None:
    plain: dict[str, Any] = {
        "arrays": [np.arange(3.0), np.ones((2, 2), np.float32), np.array(["a", "b"])],
        "numbers": [np.float32(2.5), np.int64(3), True, None],
        "sets": {1, 2},
        "ordered": OrderedDict(a=1),
        "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    }
    found = unpickle(pickle.dumps(plain, protocol))
    for mine, theirs in zip(plain["arrays"], found["arrays"], strict=True):
        assert (mine == theirs).all()
    assert found["numbers"] == plain["numbers"]
    assert (found["sets"], found["ordered"]) == (plain["sets"], plain["ordered"])
    assert (found["fortran"] == plain["fortran"]).all()


class Hostile:
    """An object that calls a function when it is unpickled."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> tuple[Any, ...]:
        return self.call[0], tuple(self.call[1:])


@pytest.mark.parametrize(
    "bad",
    [
        Hostile(os.system, "touch /tmp/never"),
        Hostile(eval, "1"),
        Hostile(getattr, 1, "real"),
        Hostile(np.load, "/etc/passwd"),
        Hostile(np.dtype, "O"),
        np.array([{}], dtype=object),
        np.zeros(2, dtype=[("a", "f8")]),
        Path("a"),
        Hostile(bytearray, 1 << 60),
    ],
)
def test_pickles_that_name_functions_or_classes_are_refused(bad: object, tmp_path: Path) -> None:
    path = write_pickle(tmp_path, {"id": bad})
    with pytest.raises(MapError, match=r"made\.pkl: the pickle contains .*only builtins"):
        read_scene(path)
    assert not Path("/tmp/never").exists()


@pytest.mark.parametrize(
    "content",
    [
        # changes the defaults of a function that the reader uses
        b"\x80\x02c_codecs\nencode\nN}X\x0c\x00\x00\x00__defaults__)s\x86b.",
        b"\x80\x02c_codecs\nencode\n}X\x01\x00\x00\x00aNsb.",
        b"\x80\x02Nr\xff\xff\xff\x7f.",  # an index of the memo that needs 32 GB
        b"\x80\x05\x96\x00\x00\x00\x00\x01\x00\x00\x00.",  # a bytearray of 4 GB
        b"\x80\x05\x97.",  # refers to a buffer outside of the pickle
        b"Pa\n.",
    ],
)
def test_pickles_that_reserve_memory_or_change_functions_are_refused(content: bytes) -> None:
    with pytest.raises(MapError, match=r"only builtins|broken pickle"):
        unpickle(content)


@pytest.mark.parametrize("code", [">f8", ">f4", ">i4", ">U3", "<f8"])
def test_arrays_of_any_byte_order_are_read(code: str) -> None:
    numbers = np.arange(3).astype(code)
    for protocol in (2, 5):
        assert unpickle(pickle.dumps(numbers, protocol)).tolist() == numbers.tolist()
        assert unpickle(pickle.dumps(numbers[1], protocol)) == numbers[1]


def test_the_state_of_a_dtype_cannot_turn_bytes_into_objects() -> None:
    content = pickle.dumps(np.array([b"abcdefgh"]), 2)
    state = b"NNNK\x08K\x01K\x00t"  # subtype, names, fields, size, alignment, flags of the dtype
    assert content.count(state) == 1
    found = unpickle(
        content.replace(state, b"NNNK\x08K\x01K\x3ft")
    )  # these flags say that the array contains objects
    assert not found.dtype.hasobject
    assert found.tolist() == [b"abcdefgh"]
    named = content.replace(state, b"N)}K\x08K\x01K\x00t")
    with pytest.raises(MapError, match="an array of records"):
        unpickle(named)


def test_arrays_with_items_of_size_0_are_refused() -> None:
    """A small file could claim any number of such items."""
    with pytest.raises(MapError, match="an array of dtype 'S0'"):
        unpickle(pickle.dumps(Hostile(np.dtype, "S0")))


def _shared(scene: dict[str, Any]) -> None:
    rows: list[Any] = [[0.0, 0.0, 0.0]]
    for _ in range(12):
        rows = [rows] * 8  # 8 ** 12 numbers in 100 bytes
    scene["map_features"]["inE"]["polyline"] = rows


def _crowd(scene: dict[str, Any]) -> None:
    scene["tracks"] |= {str(k): scene["tracks"]["parked"] for k in range(5000)}


def _many_samples(scene: dict[str, Any]) -> None:
    scene["length"] = 90_000
    scene["metadata"]["ts"] = np.arange(90_000) * 0.1
    scene["tracks"] |= {str(k): scene["tracks"]["parked"] for k in range(200)}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_shared, "lane 'inE': must be an array of numbers"),
        (_crowd, "5003 tracks of 91 samples: must be at most 4000 tracks"),
        (_many_samples, "203 tracks of 90000 samples"),
    ],
)
def test_shared_content_of_a_pickle_cannot_fill_the_memory(
    change: Change, message: str, tmp_path: Path
) -> None:
    scene = scenario()
    change(scene)
    path = write_pickle(tmp_path, scene)
    assert path.stat().st_size < 3_000_000
    with pytest.raises(MapError, match=message):
        read_scene(path)


@pytest.mark.parametrize(
    "content", [b"", b"no pickle", pickle.dumps(scenario())[:1000], b"\x80\x05"]
)
def test_broken_pickles_are_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "broken.pkl"
    path.write_bytes(content)
    with pytest.raises(MapError, match=r"broken\.pkl: broken pickle .*export the scene again"):
        read_scene(path)


def _state(name: str, key: str, value: object) -> Change:
    return lambda scene: scene["tracks"][name]["state"].__setitem__(key, value)


def _nan(scene: dict[str, Any]) -> None:
    scene["tracks"]["8"]["state"]["position"][3, 0] = np.nan


WRONG_SCENARIOS: dict[str, tuple[Change, str]] = {
    "no tracks": (lambda s: s.pop("tracks"), "tracks: must be a mapping"),
    "length": (lambda s: s.update(length=0), "length = 0: must be a whole number"),
    "short": (_state("7", "heading", np.zeros(3)), "heading of track '7': has the shape"),
    "text": (_state("7", "heading", ["a"] * TIMES), "must be an array of numbers"),
    "nan": (_nan, "track '8': a valid pose is not finite"),
    "size": (_state("7", "length", np.zeros(TIMES)), "must be above 0"),
    "uneven": (
        lambda s: s["metadata"].update(ts=np.cumsum(np.arange(TIMES) % 3 + 1.0)),
        "not evenly spaced",
    ),
    "backwards": (lambda s: s["metadata"].update(ts=-np.arange(TIMES)), "ascending seconds"),
    "no time": (lambda s: s["metadata"].pop("ts"), "metadata.ts"),
    "no lanes": (lambda s: s["map_features"].clear(), "no lane for motor vehicles"),
    "nobody": (lambda s: s["tracks"].clear(), "no track of a vehicle"),
    "bad lane": (
        lambda s: s["map_features"]["inE"].update(polyline=[[np.inf, 0.0], [1.0, 1.0]]),
        "lane 'inE': a point is not finite",
    ),
}


@pytest.mark.parametrize("name", WRONG_SCENARIOS)
def test_invalid_scenarios_are_refused_with_place_and_cause(name: str, tmp_path: Path) -> None:
    change, message = WRONG_SCENARIOS[name]
    scene = scenario()
    change(scene)
    with pytest.raises(MapError, match=r"made\.pkl: ") as caught:
        read_scene(write_pickle(tmp_path, scene))
    assert message in str(caught.value)


WRONG_DOCUMENTS: dict[str, tuple[Change, str]] = {
    "no objects": (lambda s: s.pop("objects"), "objects: must be a list"),
    "no roads": (lambda s: s.update(roads=3), "roads: must be a list"),
    "different lengths": (
        lambda s: [s["objects"][0][key].pop() for key in ("position", "heading", "valid")],
        "must all have the same number",
    ),
    "no heading": (lambda s: s["objects"][0].pop("heading"), "heading of object '0'"),
    "point": (lambda s: s["roads"][0].update(geometry=[{"x": 1.0}]), "must have the numbers x and"),
    "same id": (lambda s: s["objects"][1].update(id=0), "two tracks are named '0'"),
    "size": (lambda s: s["objects"][0].update(length="long"), "size of object '0'"),
    "list": (lambda s: s.update(objects=[3]), "object 0: must be a mapping"),
}


@pytest.mark.parametrize("name", WRONG_DOCUMENTS)
def test_invalid_json_scenes_are_refused_with_place_and_cause(name: str, tmp_path: Path) -> None:
    change, message = WRONG_DOCUMENTS[name]
    scene = gpudrive()
    change(scene)
    with pytest.raises(MapError, match=r"made\.json: ") as caught:
        read_scene(write_json_scene(tmp_path, scene))
    assert message in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "[1]", "\x00"])
def test_broken_json_is_refused(text: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.json"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MapError, match=r"broken\.json: "):
        read_scene(path)


def test_tracks_are_cut_at_jumps_and_overlaps_are_counted(tmp_path: Path) -> None:
    scene = scenario()
    scene["tracks"]["8"]["state"]["position"][50:, 0] -= 60.0
    scene["tracks"]["twin"] = scene["tracks"]["parked"]
    found = read_scene(write_pickle(tmp_path, scene))
    assert "1 jumps of over 60 m/s, at which tracks were cut" in found.notes
    assert "1 pairs of tracks overlap at some time" in found.notes
    first, second = (track for track in found.tracks if track.name.startswith("8"))
    assert (first.name, second.name) == ("8", "8#2")
    assert first.times.tolist() == list(range(50))
    assert second.times.tolist() == list(range(50, TIMES))


def test_parts_of_a_cut_track_get_unused_names(tmp_path: Path) -> None:
    scene = scenario()
    scene["tracks"]["8"]["state"]["position"][50:, 0] -= 60.0
    scene["tracks"]["8#2"] = scene["tracks"]["parked"]
    names = [track.name for track in read_scene(write_pickle(tmp_path, scene)).tracks]
    assert names == ["7", "8", "8#3", "9", "walker", "rider", "parked", "8#2"]


@pytest.mark.parametrize(
    ("stated", "mps"),
    [
        ({"speed_limit_kmh": 72.0, "speed_limit_mph": 45.0}, 20.0),
        ({"speed_limit_kmh": 0.0, "speed_limit_mph": 45.0}, 20.1168),
        ({"speed_limit_mps": 11.2}, 11.2),  # as in nuPlan
        ({"speed_limit_mps": None}, None),
        (
            {"speed_limit_kmh": 1000.0},
            None,
        ),  # the default of MetaDrive means that the limit is unknown
        ({}, None),
    ],
)
def test_speed_limits_are_read_in_all_units(
    stated: dict[str, Any], mps: float | None, tmp_path: Path
) -> None:
    scene = scenario()
    lane = scene["map_features"]["inE"]
    del lane["speed_limit_kmh"]
    lane.update(stated)
    found = read_scene(write_pickle(tmp_path, scene)).lanes[0].speed_mps
    assert found == (None if mps is None else pytest.approx(mps))


def test_headings_in_place_of_heights_are_recognized(tmp_path: Path) -> None:
    """Lanes of nuScenes have points (x, y, heading) instead of (x, y, z)."""
    scene, slope = scenario(), scenario()
    for number, changed in enumerate((scene, slope)):
        for feature in changed["map_features"].values():
            if feature["type"].startswith("LANE"):
                line = feature["polyline"]
                moves = np.diff(line, axis=0, append=2.0 * line[-1:] - line[-2:-1])
                heading = np.arctan2(moves[:, 1], moves[:, 0])
                line[:, 2] = 0.05 * line[:, 0] if number else heading
    found = read_scene(write_pickle(tmp_path, scene))
    assert all((lane.points[:, 2] == 0.0).all() for lane in found.lanes)
    assert "20 lanes with headings in place of heights: height 0" in found.notes
    found = read_scene(write_pickle(tmp_path, slope))
    assert np.ptp(found.lanes[0].points[:, 2]) > 3.0
    assert not any("headings" in note for note in found.notes)


def test_sidewalks_are_ignored_and_counted(tmp_path: Path) -> None:
    """In scenes of nuPlan and nuScenes, sidewalks are areas with a type of road edges."""
    scene = scenario()
    scene["map_features"]["walk"] = {"type": "ROAD_EDGE_SIDEWALK", "polygon": np.zeros((4, 2))}
    found = read_scene(write_pickle(tmp_path, scene))
    assert "1 sidewalks ignored" in found.notes
    assert len(found.road_edges) == 4


def test_ignored_tracks_and_map_features_are_counted(tmp_path: Path) -> None:
    scene = scenario()
    scene["tracks"]["cone"] = {**scene["tracks"]["parked"], "type": "TRAFFIC_CONE"}
    scene["map_features"]["bikes"] = {**scene["map_features"]["inE"], "type": "LANE_BIKE_LANE"}
    scene["map_features"]["zebra"] = {"type": "CROSSWALK", "polygon": np.zeros((4, 2))}
    scene["dynamic_map_states"]["1"] = {"type": "TRAFFIC_LIGHT"}
    for key in ("length", "width", "height"):
        del scene["tracks"]["walker"]["state"][key]
    notes = read_scene(write_pickle(tmp_path, scene)).notes
    assert "1 tracks of type TRAFFIC_CONE ignored" in notes
    assert "1 bicycle lanes ignored" in notes
    assert "1 map features of type CROSSWALK ignored" in notes
    assert "1 traffic lights ignored" in notes
    assert "1 tracks without width: default of their type" in notes
