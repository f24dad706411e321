"""Clients record the world, read the recordings, and replay them."""

from __future__ import annotations

import errno
import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cavmarl.cosim.carla.call_table import Caller, answer
from cavmarl.cosim.carla.carla_recorder import ACTORS_FILE
from cavmarl.cosim.carla.carla_session import CarlaSession, SessionLimits
from cavmarl.recordings.recording import Recording
from tests.cosim.carla.conftest import Call, make_server, run_client, running_server

POSE = [[0.0, 0.0, 2.0], [0.0, 0.0, 0.0]]
TICKS = 30


def calls_of(session: CarlaSession) -> Call:
    def call(name: str, *arguments: Any) -> Any:
        error, result = answer(Caller("test"), session, name, list(arguments))
        assert error is None
        match result:
            case [[False]]:
                return None
            case [[True, [message]]] | [[0, [message]]]:
                raise RuntimeError(message)
            case [[1, value]]:
                return value
        raise AssertionError(result)

    return call


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "recordings"


@pytest.fixture
def own_session(folder: Path) -> Iterator[CarlaSession]:
    with make_server(recordings=folder) as server:
        yield server.session


def positions_of(session: CarlaSession) -> dict[int, list[float]]:
    """Return the positions of the actors in the next snapshot, by actor number."""
    states = session.actors.vehicle_states
    return dict(zip(states["id"].tolist(), states["place"].tolist(), strict=True))


def record_ticks(
    session: CarlaSession, call: Call, name: str = "test1.log"
) -> list[dict[int, Any]]:
    """Record `TICKS` ticks; return the positions of the actors in each frame."""
    call("start_recorder", name, True)
    found = [positions_of(session)]
    for _ in range(TICKS):
        session.tick()
        found.append(positions_of(session))
    call("stop_recorder")
    return found


def test_a_replay_shows_the_recorded_vehicles_and_then_the_world(
    own_session: CarlaSession, folder: Path
) -> None:
    session, call = own_session, calls_of(own_session)
    for _ in range(5):
        session.tick()
    due = record_ticks(session, call)
    session.tick()
    left = session.world.env.state_hash()
    last = positions_of(session)
    text = call("replay_file", "test1.log", 0.5, 0.75, 0, False, [[0.0] * 3, [0.0] * 3])
    assert "Replaying from 0.5 s - 1.25 s (1.5 s)" in text
    # This session made the recording, so the actors keep their numbers.
    assert positions_of(session) == due[10]
    for k in range(11, 26):
        session.tick()
        assert positions_of(session) == due[k]
    assert session.world.env.state_hash() == left, "the world moves during the replay"
    session.tick()
    assert positions_of(session) == last, "the replay does not end"
    session.tick()
    assert positions_of(session) != last
    assert session.world.env.state_hash() != left
    # The recording has the format of cavmarl.
    recording = Recording.open(folder / "test1.log")
    assert recording.is_whole
    assert len(recording.ticks()) == TICKS + 1


def test_a_recording_does_not_change_the_world(folder: Path) -> None:
    hashes = []
    for is_recorded in (False, True):
        with make_server(recordings=folder) as server:
            call = calls_of(server.session)
            if is_recorded:
                call("start_recorder", "same", False)
            for _ in range(10):
                server.session.tick()
            hashes.append(server.session.world.env.state_hash())
    assert hashes[0] == hashes[1]


def by_number(session: CarlaSession) -> NDArray[np.void]:
    states = session.actors.vehicle_states
    return states[np.argsort(states["id"])].copy()


def test_a_replay_has_the_recorded_lights_and_speeds(own_session: CarlaSession) -> None:
    session, call = own_session, calls_of(own_session)
    call("start_recorder", "lights", False)
    due = []
    for _ in range(TICKS):
        session.tick()
        due.append((session.actors.lights["light_state"].copy(), by_number(session)))
    call("stop_recorder")
    for _ in range(400):  # until the lights differ from the first frame
        session.tick()
        if (session.actors.lights["light_state"] != due[0][0]).any():
            break
    call("replay_file", "lights", 0.0, 0.0, 0, False)
    for k in range(TICKS):
        session.tick()
        assert np.array_equal(session.actors.lights["light_state"], due[k][0])
        states = by_number(session)
        for field in ("velocity", "turn", "speed_limit"):
            np.testing.assert_allclose(states[field], due[k][1][field], atol=1e-5)
        np.testing.assert_allclose(states["spin"], due[k][1]["spin"], atol=0.5)


def test_clients_cannot_change_the_vehicles_of_a_replay(own_session: CarlaSession) -> None:
    session, call = own_session, calls_of(own_session)
    record_ticks(session, call)
    call("replay_file", "test1.log", 0.0, 0.0, 0, False)
    number = session.actors.vehicles[0].number
    control = [0.5, 0.0, 0.0, False, False, False, 0]
    for name, *arguments in (
        ("apply_control_to_vehicle", number, control),
        ("spawn_actor", [1, "vehicle.audi.tt", []], POSE),
        ("start_recorder", "other", False),
    ):
        with pytest.raises(RuntimeError, match="a recording is being replayed, and the world"):
            call(name, *arguments)
    call("stop_replayer", True)
    before = session.world.env.state_hash()
    session.tick()
    assert session.world.env.state_hash() != before


def test_a_sensor_can_be_attached_during_a_replay(own_session: CarlaSession) -> None:
    session, call = own_session, calls_of(own_session)
    record_ticks(session, call)
    call("replay_file", "test1.log", 0.0, 0.0, 0, False)
    parent = session.actors.vehicles[0]
    kind = [1, "sensor.other.gnss", []]
    number = call("spawn_actor_with_parent", kind, POSE, parent.number, 0, "")[0]
    session.tick()
    there = positions_of(session)[parent.number]
    assert session.actors.actors[number].pose.place[:2] == pytest.approx(there[:2], abs=0.1)
    call("stop_replayer", True)
    assert number in session.actors.actors
    there = positions_of(session)[parent.number]
    assert session.actors.actors[number].pose.place[:2] == pytest.approx(there[:2], abs=0.1)
    call("destroy_actor", number)


def test_the_spectator_follows_an_actor_of_the_replay(own_session: CarlaSession) -> None:
    session, call = own_session, calls_of(own_session)
    due = record_ticks(session, call)
    followed = session.actors.of_agent(0)
    assert followed is not None
    offset = [[0.0, 0.0, 20.0], [-90.0, 0.0, 0.0]]
    call("replay_file", "test1.log", -1.0, 0.0, followed.number, False, offset)
    session.tick()
    x, y, z = due[TICKS - 20 + 1][followed.number]
    assert session.actors.spectator.pose.place == pytest.approx((x, y, z + 20.0), abs=0.5)
    with pytest.raises(RuntimeError, match="actor 99999 is not in the recording"):
        call("replay_file", "test1.log", 0.0, 0.0, 99999, False)


def test_a_time_factor_changes_the_speed_of_a_replay(own_session: CarlaSession) -> None:
    session, call = own_session, calls_of(own_session)
    due = record_ticks(session, call)
    call("set_replayer_time_factor", 2.0)
    assert "at 2.0x" in call("replay_file", "test1.log", 0.0, 0.0, 0, False)
    session.tick()
    session.tick()
    assert positions_of(session) == due[4]
    with pytest.raises(RuntimeError, match="must be above 0"):
        call("set_replayer_time_factor", 0.0)


def test_another_server_replays_with_new_actor_numbers(folder: Path) -> None:
    with make_server(recordings=folder) as server:
        due = record_ticks(server.session, calls_of(server.session))
    with make_server(recordings=folder, agents=1, background=20) as server:
        session, call = server.session, calls_of(server.session)
        before = set(session.actors.actors)
        call("replay_file", "test1.log", 0.0, 0.0, 0, False)
        session.tick()
        found = positions_of(session)
        assert not before & found.keys(), "a replayed actor has the number of an actor of the world"
        assert sorted(found.values()) == sorted(due[1].values())
        roles = {one.attributes["role_name"] for one in session.actors.vehicles}
        assert {"car_0", "car_1", "car_2"} <= roles


def test_reports_list_actors_collisions_and_blocked_actors(own_session: CarlaSession) -> None:
    session, call = own_session, calls_of(own_session)
    number = call("spawn_actor", [1, "static.prop.kiosk_01", []], spawn_point(session))[0]
    session.tick()
    record_ticks(session, call)
    info = call("show_recorder_file_info", "test1.log", False)
    assert f"Map: {session.map.name}\n" in info
    assert "Frame 1 at 0 seconds\n" in info
    assert info.endswith(f"\nFrames: {TICKS + 1}\nDuration: 1.5 seconds\n")
    for actor in session.actors.vehicles:
        assert f" Create {actor.number}: {actor.type_id} (" in info
    assert f" Create {number}: static.prop.kiosk_01 (0) at (" in info
    assert "  role_name = car_0\n" in info
    everything = call("show_recorder_file_info", "test1.log", True)
    assert everything.count(f" Position {number}: (") == TICKS
    blocked = call("show_recorder_actors_blocked", "test1.log", 1.4, 10.0)
    (line,) = (one for one in blocked.splitlines() if "static.prop" in one)
    assert line.split() == ["0.00", str(number), "static.prop.kiosk_01", "1.50"]
    assert "static.prop" not in call("show_recorder_actors_blocked", "test1.log", 60.0, 10.0)
    assert "Frames: 31" in call("show_recorder_collisions", "test1.log", ord("v"), ord("a"))
    with pytest.raises(RuntimeError, match="120 is not the code of a kind of actors: use one of"):
        call("show_recorder_collisions", "test1.log", ord("x"), ord("a"))


def spawn_point(session: CarlaSession) -> list[Any]:
    """Return a free spawn point."""
    taken = np.array(list(positions_of(session).values()))[:, :2]
    for pose in session.map.spawn_points:
        if np.linalg.norm(taken - pose.place[:2], axis=1).min() > 30.0:
            return pose.packed()
    raise AssertionError


def test_a_collision_is_in_the_report(folder: Path) -> None:
    with make_server(agents=1, background=0, recordings=folder) as server:
        session, call = server.session, calls_of(server.session)
        agent = session.actors.of_agent(0)
        assert agent is not None
        for _ in range(200):
            session.tick()
            now = session.actors.state_of(agent)
            assert now is not None
            if np.linalg.norm(now["velocity"]) > 5.0:
                break
        ahead = session.actors.pose_of(agent)
        way = np.array(now["velocity"]) / np.linalg.norm(now["velocity"]) * 12.0
        there = ahead.at((float(ahead.x + way[0]), float(ahead.y + way[1]), ahead.z))
        wall = call("spawn_actor", [1, "static.prop.kiosk_01", []], there.packed())[0]
        call("start_recorder", "crash", False)
        full = [1.0, 0.0, 0.0, False, False, False, 0]
        call("apply_control_to_vehicle", agent.number, full)
        for _ in range(60):
            session.tick()
        call("stop_recorder")
        text = call("show_recorder_collisions", "crash", ord("a"), ord("a"))
        lines = [one for one in text.splitlines() if "kiosk_01" in one]
        assert lines, text
        assert f"{agent.number} vehicle.tesla.model3" in lines[0]
        assert f"{wall} static.prop.kiosk_01" in lines[0]
        assert "kiosk_01" not in call("show_recorder_collisions", "crash", ord("w"), ord("a"))


@pytest.mark.parametrize("name", ["../out", "/tmp/a.log", "a/b", "", ".hidden", "a" * 101, "a\n"])
def test_the_name_of_a_recording_cannot_lead_out_of_the_folder(
    name: str, own_session: CarlaSession, folder: Path
) -> None:
    call = calls_of(own_session)
    for method, *arguments in (
        ("start_recorder", False),
        ("show_recorder_file_info", False),
        ("replay_file", 0.0, 0.0, 0, False),
    ):
        with pytest.raises(RuntimeError, match="is not the name of a recording: use letters"):
            call(method, name, *arguments)
    assert not folder.exists()


def test_other_files_are_refused(own_session: CarlaSession, folder: Path) -> None:
    session, call = own_session, calls_of(own_session)
    with pytest.raises(RuntimeError, match=r"none: is not a recording of a CARLA server \(No such"):
        call("replay_file", "none", 0.0, 0.0, 0, False)
    call("start_recorder", "half", False)
    session.tick()
    with pytest.raises(RuntimeError, match="half is being recorded; call stop_recorder first"):
        call("show_recorder_file_info", "half", False)
    call("stop_recorder")
    with pytest.raises(RuntimeError, match=r"at 5 s, as the recording lasts 0\.05 s"):
        call("replay_file", "half", 5.0, 0.0, 0, False)
    actors = folder / "half" / ACTORS_FILE
    lines = actors.read_text().splitlines()
    wrong = json.loads(lines[1]) | {"type_id": "vehicle.none"}
    for text in ("", "{}", "[1]", "\x00", "\n".join([lines[0], json.dumps(wrong)])):
        actors.write_text(text)
        with pytest.raises(RuntimeError, match=f"half/{ACTORS_FILE}: is damaged"):
            call("replay_file", "half", 0.0, 0.0, 0, False)
    (folder / "notes").mkdir()
    (folder / "notes" / "mine.txt").write_text("kept")
    with pytest.raises(RuntimeError, match="exists and is not empty"):
        call("start_recorder", "notes", False)
    assert (folder / "notes" / "mine.txt").read_text() == "kept"
    session.tick()


def test_a_recording_of_the_same_name_is_replaced(own_session: CarlaSession, folder: Path) -> None:
    session, call = own_session, calls_of(own_session)
    record_ticks(session, call)
    call("start_recorder", "test1.log", False)
    session.tick()
    call("stop_recorder")
    assert len(Recording.open(folder / "test1.log").ticks()) == 2


def test_a_recording_of_another_map_is_refused(folder: Path) -> None:
    with make_server(recordings=folder) as server:
        record_ticks(server.session, calls_of(server.session))
    with make_server(recordings=folder, env="ring") as server:
        call = calls_of(server.session)
        with pytest.raises(RuntimeError, match=r"load_world\('grid4x4'\)"):
            call("replay_file", "test1.log", 0.0, 0.0, 0, False)


def test_a_long_recording_ends(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    limits = SessionLimits(max_recorded=50)
    with make_server(recordings=folder, limits=limits) as server:
        record_ticks(server.session, calls_of(server.session))
    assert "it has reached its limit of 50 rows" in caplog.text
    assert len(Recording.open(folder / "test1.log").ticks()) == 5


class FullDisk(io.StringIO):
    """A file on a disk that has room for `lines` lines."""

    def __init__(self, lines: int) -> None:
        super().__init__()
        self.lines = lines

    def flush(self) -> None:
        self.lines -= 1
        if self.lines < 0:
            raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("lines", [0, 3])
def test_a_full_disk_ends_the_recording_but_not_the_server(
    lines: int,
    own_session: CarlaSession,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    session, call = own_session, calls_of(own_session)
    with monkeypatch.context() as patched:
        opened = Path.open
        patched.setattr(
            Path,
            "open",
            lambda path, *mode, **more: (
                FullDisk(lines) if path.name == ACTORS_FILE else opened(path, *mode, **more)
            ),
        )
        if lines:
            call("start_recorder", "full", False)
            assert "the recording ends: [Errno 28] No space left on device" in caplog.text
        else:
            with pytest.raises(RuntimeError, match=r"full: cannot be written \(No space left on"):
                call("start_recorder", "full", False)
        session.tick()
    record_ticks(session, call)  # another recording can be made


def test_without_a_folder_nothing_is_recorded() -> None:
    with make_server() as server:
        with pytest.raises(RuntimeError, match="start it with --recordings FOLDER"):
            calls_of(server.session)("start_recorder", "test", False)


CLIENT = """
settings = world.get_settings()
settings.synchronous_mode, settings.fixed_delta_seconds = True, 0.05
world.apply_settings(settings)
world.tick()
agent = next(one for one in world.get_actors().filter("vehicle.*")
             if one.attributes["role_name"] == "car_0")
found["started"] = client.start_recorder("test1.log", True)
due = []
for _ in range(30):
    world.tick()
    due.append(agent.get_location())
client.stop_recorder()
found["info"] = client.show_recorder_file_info("test1.log", False)
found["blocked"] = client.show_recorder_actors_blocked("test1.log", 1.0, 100.0)
found["collisions"] = client.show_recorder_collisions("test1.log", "v", "a")
for _ in range(20):
    world.tick()
after = agent.get_location()
client.set_replayer_time_factor(1.0)
found["replay"] = client.replay_file("test1.log", 0.0, 0.0, agent.id)
found["apart"] = 0.0
for place in due:
    world.tick()
    found["apart"] = max(found["apart"], agent.get_location().distance(place))
found["behind"] = world.get_spectator().get_location().distance(agent.get_location())
world.tick()
world.tick()
found["back"] = agent.get_location().distance(after)
client.stop_replayer(False)
"""


def test_the_official_client_records_and_replays(folder: Path) -> None:
    with running_server(recordings=folder) as port:
        found = run_client(port, CLIENT)
    assert found["started"] == str(folder / "test1.log")
    assert "Frames: 31\nDuration: 1.5 seconds" in found["info"]
    assert "Duration" in found["blocked"]
    assert "Actor 1" in found["collisions"]
    assert "Replaying from 0 s - 1.5 s" in found["replay"]
    assert found["apart"] < 1e-3
    assert 10.0 < found["behind"] < 13.0
    assert found["back"] < 1.0
