"""Nodes join and leave, and sessions move; the tests set the clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pydantic import ValidationError

from cavmarl.balance.load_score import LoadRule
from cavmarl.core.errors import ServiceError
from cavmarl.service import rate_limit
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.node_host import run_evaluation
from cavmarl.service.node_selection import NoNodeError
from cavmarl.service.rate_limit import RateLimit
from cavmarl.service.response_builders import session_answer
from tests.support.fleet import CONFIGURATION, Fleet


@pytest.fixture
def fleet(tmp_path: Path) -> Iterator[Fleet]:
    made = Fleet(tmp_path / "store.sqlite")
    yield made
    made.close()


def reasons(fleet: Fleet, **given: object) -> dict[str, str]:
    with pytest.raises(NoNodeError) as refused:
        fleet.open(**given)
    return {one.node: one.reason for one in refused.value.exclusions}


def test_a_node_without_heartbeats_is_down_until_its_next_heartbeat(fleet: Fleet) -> None:
    fleet.join("a")
    fleet.now_s += 3.0
    fleet.broker.sweep()
    assert fleet.log.state.nodes["a"].state == "up"
    fleet.now_s += 0.1
    fleet.broker.sweep()
    assert fleet.log.state.nodes["a"].state == "down"
    assert reasons(fleet) == {"a": "unavailable"}
    fleet.beat("a")
    assert fleet.open().node == "a"
    assert fleet.kinds()[-4:-2] == ["node.down", "node.up"]


def test_nodes_report_the_progress_of_their_jobs(fleet: Fleet) -> None:
    fleet.join("a")
    job = fleet.open(job={"policies": ["idm"], "episodes": 1, "repeats": 1})
    service = SimpleNamespace(broker=fleet.broker)
    assert session_answer(service, job).progress is None
    told = fleet.beat_of("a", jobs={job.id: [30, 400]})
    fleet.broker.beat(fleet.nodes, "a", told)
    assert session_answer(service, job).progress == [30, 400]
    with pytest.raises(ValidationError):
        fleet.beat_of("a", jobs={job.id: [30]})


def test_a_node_with_a_session_on_an_open_page_receives_all_scores(fleet: Fleet) -> None:
    fleet.join("a", "b")
    fleet.register("c")
    session = fleet.open()
    told = fleet.broker.beat(fleet.nodes, "a", fleet.beat_of("a", watched=True))
    scores = {one["name"]: one for one in told["scores"]}
    assert list(scores) == ["a", "b", "c"]
    assert scores["c"]["score"] is None
    assert scores["a"]["score"] == pytest.approx(0.6 * 0.1 + 0.2 * 0.1)
    assert scores[session.node or ""]["sessions"] == 1
    assert fleet.beat("a")["scores"] == []


def test_the_progress_of_a_job_counts_the_steps_of_all_runs_and_drivers(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def evaluate_steps(*_: Any, progress: Any, **more: Any) -> None:
        for policy in ("idm", "random") * more["repeats"]:
            for step in (1, 2):
                progress(policy, step, 4)

    told: list[tuple[int, int]] = []
    monkeypatch.setattr("cavmarl.service.node_host.evaluate", evaluate_steps)
    monkeypatch.setattr("cavmarl.service.node_host.TELL_S", 0.0)
    world = {"environment": "ring", "seed": 1, "overrides": {}}
    world |= dict.fromkeys(("agents", "background", "max_cycles"))
    job = {"policies": ["idm", "random"], "episodes": 1, "repeats": 2}
    run_evaluation(world, job, tmp_path, None, lambda *counts: told.append(counts))
    assert told == [(done, 16) for done in (1, 2, 5, 6, 9, 10, 13, 14)]


def test_a_node_with_an_old_or_missing_load_gets_no_session(fleet: Fleet) -> None:
    fleet.join("a")
    fleet.now_s += 3.5  # the load is old, but the broker has not searched for lost nodes yet
    assert reasons(fleet) == {"a": "stale"}
    fleet.register("b")  # b has reported no load yet
    assert reasons(fleet) == {"a": "stale", "b": "stale"}


def test_fifty_requests_over_five_equal_nodes_give_ten_to_each(fleet: Fleet) -> None:
    fleet.join(*"abcde", slots=16)
    found = Counter(fleet.open().node for _ in range(50))
    assert found == dict.fromkeys("abcde", 10)


def test_a_node_with_slightly_less_load_does_not_get_all_sessions(fleet: Fleet) -> None:
    fleet.join("a", "b", slots=16)
    fleet.beat("b", cpu=0.05)
    found = Counter(fleet.open().node for _ in range(20))
    assert found == {"a": 10, "b": 10}


def test_a_new_session_counts_as_the_load_of_one_slot(fleet: Fleet) -> None:
    fleet.join("a", "b", slots=16)
    fleet.beat("a", cpu=0.05)
    fleet.beat("b", cpu=0.35)
    # Each session adds 1 / 16 to the load. With five sessions, a has 0.3625, which is more than b.
    assert [fleet.open().node for _ in range(6)] == ["a"] * 5 + ["b"]


def test_zones_of_other_sessions_take_slots(fleet: Fleet) -> None:
    fleet.join("a", "b", slots=1)
    assert fleet.open(zone_nodes=2).members
    with pytest.raises(NoNodeError) as refused:
        fleet.open()
    assert {(one.node, one.reason) for one in refused.value.exclusions} == {
        ("a", "capacity"), ("b", "capacity")
    }  # fmt: skip


@pytest.mark.parametrize(
    ("busy", "reason"), [({"cpu": 0.851}, "cpu"), ({"ram": 0.901}, "ram"), ({"gpu": 0.951}, "gpu")]
)
def test_one_overloaded_resource_excludes_a_node(
    fleet: Fleet, busy: dict[str, float], reason: str
) -> None:
    fleet.join("a")
    fleet.beat("a", **busy)
    assert reasons(fleet) == {"a": reason}
    assert "node.overloaded" in fleet.kinds()
    fleet.beat("a", **{name: value - 0.001 for name, value in busy.items()})
    assert fleet.open().node == "a"


def test_a_waiting_job_names_the_limit_that_it_waits_for(fleet: Fleet) -> None:
    fleet.join("a", slots=1)
    fleet.beat("a", cpu=0.97)
    job = fleet.open(job={"policies": ["idm"], "episodes": 1, "repeats": 1})
    limit = "cpu 0.97 is above the threshold 0.85; wait, or raise it with cavmarl serve --threshold"
    assert f"no node can take this (a: {limit}" in fleet.broker.jobs.reason_of(job)
    assert fleet.broker.limits_of("a")[0].startswith(limit)
    fleet.beat("a", cpu=0.1)
    assert job.node == "a"
    assert fleet.broker.jobs.reason_of(job) == ""
    assert "--slots" in fleet.broker.limits_of("a")[0]
    with pytest.raises(NoNodeError, match=r"a: has no free slot; .* --slots\)\. Wait, ask with"):
        fleet.open()
    fleet.broker.drain(fleet.nodes, "a")
    assert "cavmarl nodes --resume" in fleet.broker.limits_of("a")[0]
    fleet.now_s += 10.0
    assert fleet.broker.limits_of("a")[0].startswith("has sent no load lately")


def test_a_broker_uses_the_given_thresholds_and_weights(tmp_path: Path) -> None:
    rule = LoadRule(weights=(1.0, 0.0, 0.0), thresholds=(0.98, 0.9, 0.95))
    fleet = Fleet(tmp_path / "store.sqlite", load=rule)
    fleet.join("a")
    fleet.beat("a", cpu=0.97, ram=0.5)
    assert fleet.broker.limits_of("a") == []
    assert fleet.open().score == pytest.approx(0.97)
    fleet.close()


def test_capacity_capability_and_access_exclude_nodes(fleet: Fleet) -> None:
    fleet.join("full", slots=1)
    fleet.open()
    fleet.join("plain")
    fleet.join("others", capabilities=["gpu"], allowed=["bob"])
    assert reasons(fleet, needs=["gpu"]) == {
        "full": "capability",
        "plain": "capability",
        "others": "access",
    }
    assert {fleet.open().node for _ in range(4)} == {"plain"}
    assert reasons(fleet) == {"full": "capacity", "plain": "capacity", "others": "access"}


def test_a_node_serves_an_allowed_client_if_it_has_all_needed_capabilities(fleet: Fleet) -> None:
    fleet.join("own", capabilities=["gpu", "tls"], allowed=["bob", "ada"])
    assert fleet.open(needs=["gpu", "tls"]).node == "own"
    assert reasons(fleet, needs=["gpu", "sumo"]) == {"own": "capability"}


def test_a_job_that_no_node_serves_does_not_delay_another_client(fleet: Fleet) -> None:
    bob = fleet.identity("bob", "client")
    job = {"policies": ["idm"], "episodes": 1, "repeats": 1}
    first = fleet.open(job=job)
    second = fleet.broker.open(bob, CONFIGURATION, job=job)
    fleet.join("bobs", allowed=["bob"])
    assert (first.node, second.node) == (None, "bobs")


def test_a_session_is_redirected_by_the_rule_of_the_paper(fleet: Fleet) -> None:
    fleet.join("a", "b", "c")
    fleet.beat("b", cpu=0.12)
    kept = fleet.open(preferred="b")
    assert (kept.node, kept.reason) == (
        "b",
        "preferred",
    )  # the score of b is only 0.012 above the best score
    fleet.beat("b", cpu=0.5)
    moved = fleet.open(preferred="b")
    assert (moved.node, moved.reason) == ("a", "preferred above margin")
    fleet.beat("b", cpu=0.9)
    assert fleet.open(preferred="b").reason == "preferred excluded"
    fleet.broker.drain(fleet.nodes, "b")
    assert fleet.open(preferred="b").reason == "preferred unavailable"
    assert fleet.open(preferred="nowhere").reason == "preferred unknown"
    assert fleet.kinds().count("session.redirected") == 4


def test_a_session_moves_if_its_node_is_drained_has_left_or_cannot_be_reached(fleet: Fleet) -> None:
    fleet.join("a", "b")
    session = fleet.open()
    assert session.node == "a"
    assert fleet.broker.resolve(fleet.client, session.id).node == "a"
    assert fleet.broker.resolve(fleet.client, session.id, ["a"]).node == "b"
    fleet.broker.drain(fleet.nodes, "b")
    assert fleet.broker.resolve(fleet.client, session.id).node == "a"
    fleet.broker.leave(fleet.nodes, "a")
    assert session.state == "queued"
    with pytest.raises(NoNodeError):
        fleet.broker.resolve(fleet.client, session.id)
    fleet.join("a")
    assert fleet.broker.resolve(fleet.client, session.id).node == "a"
    assert fleet.broker.live["b"].hosted == set()


def test_a_second_state_of_the_same_command_replaces_the_first(fleet: Fleet) -> None:
    fleet.join("a")
    session = fleet.open()
    for content in (b"state", b"state with another vehicle"):
        fleet.broker.save(session, 3, content)
    fleet.log.flush()
    assert session.saved_number == 3
    assert fleet.log.content(str(session.saved_blob)) == b"state with another vehicle"
    with pytest.raises(ServiceError, match="command 3 is stored"):
        fleet.broker.save(session, 2, b"older")


def test_the_heartbeat_of_a_superseded_process_is_refused(fleet: Fleet) -> None:
    assert fleet.register("a") == 1
    old = fleet.beat_of("a")
    assert fleet.register("a") == 2
    with pytest.raises(ServiceError, match="incarnation 2") as refused:
        fleet.broker.beat(fleet.nodes, "a", old)
    assert refused.value.problem == "superseded"


def test_a_heartbeat_with_an_old_sequence_number_is_refused(fleet: Fleet) -> None:
    fleet.join("a")
    late = fleet.beat_of("a", sequence=0)
    with pytest.raises(ServiceError) as refused:
        fleet.broker.beat(fleet.nodes, "a", late)
    assert refused.value.problem == "stale-beat"


def test_a_node_belongs_to_the_identity_that_has_registered_it(fleet: Fleet) -> None:
    fleet.join("a")
    fleet.nodes = fleet.identity("others", "node")
    for attempt in (fleet.register, fleet.beat):
        with pytest.raises(ServiceError) as refused:
            attempt("a")
        assert refused.value.problem == "forbidden"


@pytest.mark.parametrize("wrong", [{"cpu": 85.0}, {"cpu": "0.5"}, {"ram": float("nan")}, {"x": 1}])
def test_a_load_outside_of_0_to_1_is_refused(fleet: Fleet, wrong: dict[str, object]) -> None:
    fleet.join("a")
    with pytest.raises(ValidationError):
        fleet.beat_of("a", **wrong)


def test_a_wrong_clock_is_reported_once(fleet: Fleet) -> None:
    fleet.join("a")
    for skew_s in (9.0, 9.0, 0.0):
        beat = fleet.beat_of("a", sent_s=fleet.now_s + skew_s)
        fleet.broker.beat(fleet.nodes, "a", beat)
    assert [kind for kind in fleet.kinds() if kind.startswith("clock")] == [
        "clock.anomaly",
        "clock.right",
    ]


def test_a_job_waits_for_a_node_and_runs_again_if_the_node_is_lost(fleet: Fleet) -> None:
    job = fleet.open(job={"policies": ["idm"], "episodes": 1, "repeats": 1})
    assert job.state == "queued"
    fleet.join("a")
    assert fleet.beat("a")["jobs"][0]["id"] == job.id
    fleet.now_s += 10.0
    fleet.broker.sweep()
    assert job.state == "queued"
    fleet.join("b")
    assert job.node == "b"
    with pytest.raises(ServiceError, match="on no node of this identity"):
        fleet.broker.hosted(fleet.identity("strangers", "node"), job.id)
    fleet.broker.finish(fleet.broker.hosted(fleet.nodes, job.id), "done", "")
    assert (job.state, fleet.beat("b")["jobs"]) == ("done", [])


def test_unused_sessions_are_closed_and_later_deleted(fleet: Fleet) -> None:
    fleet.join("a")
    session = fleet.open()
    fleet.broker.save(session, 3, b"state")
    fleet.log.flush()
    blob = session.saved_blob
    fleet.now_s += 601.0
    fleet.broker.sweep()
    assert session.state == "closed"
    fleet.now_s += 3601.0
    fleet.broker.sweep()
    assert fleet.log.state.sessions == {}
    fleet.log.flush()
    assert blob is not None
    assert fleet.log.store.blob(blob) is None


def test_the_number_of_sessions_of_an_identity_is_limited(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path / "other.sqlite", max_sessions=2)
    fleet.join("a")
    first = fleet.open()
    fleet.open()
    with pytest.raises(ServiceError, match="2 sessions are open") as refused:
        fleet.open()
    assert refused.value.problem == "too-many"
    fleet.broker.close(fleet.client, first.id)
    assert fleet.open().node == "a"
    fleet.close()


def test_a_replay_of_the_log_gives_the_same_state(fleet: Fleet, tmp_path: Path) -> None:
    fleet.join("a", "b")
    sessions = [fleet.open() for _ in range(3)]
    fleet.broker.save(sessions[0], 7, b"content")
    fleet.broker.close(fleet.client, sessions[1].id)
    fleet.broker.drain(fleet.nodes, "a")
    fleet.access.rotate_key()
    fleet.log.flush()
    known = fleet.log.state
    fleet.log.store.close()
    again = EventLog(EventStore(tmp_path / "store.sqlite"))
    assert again.state == known
    assert again.content(sessions[0].saved_blob or "") == b"content"
    assert len(list(again.store.read_checked())) == again.sequence
    fleet.log.store = again.store


def test_a_timeout_is_recorded(fleet: Fleet) -> None:
    job = fleet.open(job={"policies": ["idm"], "episodes": 1, "repeats": 1}, wait_s=30.0)
    fleet.now_s += 29.0
    fleet.broker.sweep()
    assert job.state == "queued"
    fleet.now_s += 2.0
    fleet.broker.sweep()
    assert job.state == "failed"
    assert job.message.startswith("no node took the job within 30 s: no node can take this (")
    fleet.join("a")
    assert fleet.beat("a")["jobs"] == []
    session = fleet.open()
    fleet.now_s += 601.0
    fleet.broker.sweep()
    assert session.state == "closed"
    fleet.log.flush()
    told = [line.data for line in fleet.log.store.read() if line.kind == "session.timeout"]
    assert told == [
        {"of": "job in the queue", "after_s": 31.0},
        {"of": "idle session", "after_s": 601.0},
    ]


def test_a_job_of_a_lost_node_waits_again(fleet: Fleet) -> None:
    fleet.join("a")
    job = fleet.open(job={"policies": ["idm"], "episodes": 1, "repeats": 1}, wait_s=5.0)
    fleet.now_s += 60.0
    fleet.broker.sweep()
    assert (job.state, job.placements) == ("queued", 1)


def test_a_jump_of_the_wall_clock_is_reported_once(fleet: Fleet) -> None:
    fleet.log.wall_s = lambda: fleet.now_s - 3600.0
    fleet.broker.sweep()
    fleet.broker.sweep()
    fleet.log.flush()
    told = [line for line in fleet.log.store.read() if line.kind == "clock.anomaly"]
    assert [(line.subject, line.data) for line in told] == [("service", {"jump_s": -3600.0})]


def test_expired_tokens_are_refused(fleet: Fleet) -> None:
    tokens = fleet.access.exchange(fleet.secrets["ada"])
    fleet.now_s += 899.0
    assert fleet.access.authenticate(tokens["access_token"]).name == "ada"
    fleet.now_s += 2.0
    with pytest.raises(ServiceError, match="expired") as refused:
        fleet.access.authenticate(tokens["access_token"])
    assert refused.value.problem == "bad-token"
    fleet.now_s += 8 * 3600.0
    with pytest.raises(ServiceError, match="expired"):
        fleet.access.refresh(tokens["refresh_token"])


def test_jobs_that_no_node_can_take_delay_no_other_job(fleet: Fleet) -> None:
    asked = 0

    def count(_: float) -> None:
        nonlocal asked
        asked += 1

    fleet.broker.took_s = count
    job = {"policies": ["idm"], "episodes": 1, "repeats": 1}
    for k in range(80):
        fleet.open(job=job, needs=[f"none-{k % 60}"])
    possible = fleet.open(job=job)
    asked = 0
    fleet.join("a")  # a pass searches a node once for each kind of job, and stops after 50 failures
    for _ in range(100):
        fleet.beat("a")
    assert asked <= 52
    for _ in range(20):
        fleet.now_s += 0.5
        fleet.beat("a")
    assert possible.node == "a"
    assert asked <= 1100  # at most 100 searches per second


def test_a_pass_over_waiting_jobs_continues_where_the_previous_pass_stopped(fleet: Fleet) -> None:
    job = {"policies": ["idm"], "episodes": 1, "repeats": 1}
    early = fleet.open(job=job, needs=["x"])
    for k in range(60):
        fleet.open(job=job, needs=[f"none-{k}"])
    fleet.register("a", capabilities=["x"])
    fleet.now_s += 1.0
    fleet.broker.jobs.place()  # this pass stops after 50 failed searches
    fleet.now_s += 1.0
    fleet.beat("a")
    assert early.node == "a"


def test_jobs_are_placed_in_their_order(fleet: Fleet) -> None:
    job = {"policies": ["idm"], "episodes": 1, "repeats": 1}
    jobs = [fleet.open(job=job) for _ in range(12)]
    fleet.join("a", slots=8)
    assert [one.node for one in jobs] == ["a"] * 8 + [None] * 4


def test_a_job_fails_after_ten_nodes_were_lost_with_it(fleet: Fleet) -> None:
    job = fleet.open(job={"policies": ["idm"], "episodes": 1, "repeats": 1})
    for k in range(10):
        fleet.join(f"n{k}")
        fleet.broker.leave(fleet.nodes, f"n{k}")
    fleet.broker.sweep()
    assert (job.state, job.message) == ("failed", "10 nodes were lost while they ran the job")


def test_a_training_that_stores_states_may_lose_more_than_ten_nodes(fleet: Fleet) -> None:
    job = fleet.open(job={"settings": {}})
    for k in range(12):
        fleet.join(f"n{k}")
        if k == 5:
            fleet.broker.save(job, 1, b"state")
        fleet.broker.leave(fleet.nodes, f"n{k}")
    fleet.broker.sweep()
    assert (job.state, job.placements) == ("queued", 12)
    for k in range(12, 15):
        fleet.join(f"n{k}")
        fleet.broker.leave(fleet.nodes, f"n{k}")
    fleet.broker.sweep()
    assert (job.state, job.message) == ("failed", "10 nodes were lost while they ran the job")


def test_nodes_that_have_left_are_deleted_after_a_day(fleet: Fleet) -> None:
    fleet.join("a", "b")
    session = fleet.open(zone_nodes=2)
    fleet.broker.leave(fleet.nodes, "b")
    fleet.now_s += 86_399.0
    fleet.beat("a")
    fleet.broker.sweep()
    assert [*fleet.log.state.nodes] == ["a", "b"]
    fleet.now_s += 2.0
    fleet.beat("a")
    fleet.broker.sweep()
    assert [*fleet.log.state.nodes] == [*fleet.broker.live] == ["a"]
    assert "b" not in session.members
    fleet.join("b", "c")  # ties are broken by the order of registration
    numbers = [live.number for live in fleet.broker.live.values()]
    assert numbers == sorted(set(numbers))


def test_a_session_stores_why_other_nodes_were_excluded(fleet: Fleet) -> None:
    fleet.join("a", "b")
    fleet.beat("a", cpu=0.9)
    session = fleet.open()
    reasons = [{"node": "a", "reason": "cpu", "value": 0.9, "threshold": 0.85}]
    assert (session.excluded, session.excluded_count) == (reasons, 1)


def test_the_rate_of_requests_of_a_caller_is_limited(fleet: Fleet) -> None:
    limit = RateLimit(2.0, 3.0, lambda: fleet.now_s)
    for _ in range(3):
        limit.take("ada")
    with pytest.raises(ServiceError, match="2 requests per second") as refused:
        limit.take("ada")
    assert (refused.value.problem, refused.value.retry_s) == ("too-many", 0.5)
    limit.take("bob")
    fleet.now_s += 0.125
    with pytest.raises(ServiceError) as refused:
        limit.take("ada")
    assert refused.value.retry_s == 0.375
    fleet.now_s += 0.375
    limit.take("ada")


def test_the_rate_limit_drops_the_caller_that_asked_longest_ago(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rate_limit, "MOST_BUCKETS", 2)
    limit = RateLimit(1e-6, 2.0, lambda: fleet.now_s)
    for caller in ("ada", "bob", "bob", "ada", "cy", "cy"):
        limit.take(caller)
    assert limit.has("bob")
    assert not limit.has("ada")
    assert not limit.has("cy")


def test_a_caller_has_at_most_one_burst_after_a_pause(fleet: Fleet) -> None:
    limit = RateLimit(2.0, 3.0, lambda: fleet.now_s)
    limit.take("ada")
    fleet.now_s += 3600.0
    for _ in range(3):
        limit.take("ada")
    assert not limit.has("ada")
    with pytest.raises(ServiceError, match="2 requests per second"):
        limit.take("ada")
