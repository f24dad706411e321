"""`evaluate`: seeded runs of policies, with a manifest written before the first step."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Unpack

import numpy as np
from numpy.typing import NDArray

from cavmarl.config.checks import check_count
from cavmarl.config.world_spec import WorldKeys, WorldSpec, with_sensors_of_drivers
from cavmarl.core.errors import (
    ConfigError,
    JournalError,
    ManifestError,
    PolicyError,
    RecordingError,
    require,
)
from cavmarl.engine.world_description import describe_world
from cavmarl.engine.world_setup import load_world
from cavmarl.env.drawn_worlds import why_not_copied
from cavmarl.env.vector import CavVectorEnv
from cavmarl.evaluate.border_terms import place_rows
from cavmarl.evaluate.episodes import (
    EpisodeJob,
    Progress,
    RunData,
    Speed,
    Watcher,
    derived_seed,
    drive_run,
    worlds_at_once,
)
from cavmarl.evaluate.failure_page import write_failures
from cavmarl.evaluate.provenance.manifest import (
    MANIFEST_FILE,
    close_manifest,
    describe_policies,
    open_manifest,
    read_closed,
    write_text,
)
from cavmarl.evaluate.report import EvaluationReport, make_report
from cavmarl.evaluate.resources import summaries_of
from cavmarl.evaluate.subprocess_calls import call_in_fresh_process
from cavmarl.evaluate.tables import (
    EPISODE,
    METRICS_VERSION,
    RESOURCE,
    TRACK,
    TRANSFER,
    TRIP,
    map_outline,
    read_table,
    write_table,
)
from cavmarl.evaluate.transfer_rows import transfers_of
from cavmarl.handoff.coordinator.coordinator_setup import journal_path
from cavmarl.ownership.transfer_summary import TransferSummary
from cavmarl.parallel.backends import find_backend
from cavmarl.parallel.placement.backend_name import LOCAL
from cavmarl.parallel.worlds.local_worlds import LocalWorlds
from cavmarl.policies.loading import load_policy
from cavmarl.recordings.extra_tables import RecordOptions

Rows = NDArray[np.void]
Policies = str | Path | Sequence[str | Path] | Mapping[str, str | Path]

MAX_EPISODES = 100_000
MAX_REPEATS = 1000
MAX_FAILURES = 1000

TRIPS_FILE = "trips.csv"
EPISODES_FILE = "episodes.csv"
TRACKS_FILE = "tracks.csv"
MAP_FILE = "map.json"
SPEED_FILE = "speed.json"
FAILURES_FILE = "failures.html"
TRANSFERS_FILE = "transfers.csv"
TRANSFER_COUNTS_FILE = "transfer_counts.json"
RESULT_FILES = [TRIPS_FILE, EPISODES_FILE, TRACKS_FILE, MAP_FILE, SPEED_FILE]
PLACES_FILE = "places.json"  # only for divided worlds
TRANSFER_FILES = [TRANSFERS_FILE, TRANSFER_COUNTS_FILE]  # if the backend logs transfers
RESOURCES_FILE = "resources.csv"  # only for worlds in other processes


def evaluate(
    env: str | Path | WorldSpec,
    policies: Policies,
    *,
    episodes: int = 32,
    repeats: int = 1,
    out: Path | None = None,
    record: RecordOptions | str | Path | None = None,
    failures: int = 0,
    zones: int | None = None,
    backend: str = LOCAL,
    progress: Progress | None = None,
    watcher: Watcher | None = None,
    **keys: Unpack[WorldKeys],
) -> EvaluationReport:
    """Evaluate policies in `repeats` runs of `episodes` seeded episodes.

    All policies drive the same episodes: a run has one seed, and its episode e is the first episode
    of world e. If the trained drivers among the policies need the same sensors, the worlds get
    these sensors. Two or more runs are driven in new processes, one after the other.

    Args:
        env: as in `make_vec`, like all keywords that are not listed here.
        policies: as in `load_policy`: one, several, or a mapping: name in the results → policy.
        episodes: number of episodes of each run.
        repeats: number of independent runs.
        out: folder for manifest and raw results; None: only the report is returned.
        record: a new folder for recordings, or `RecordOptions`; each world of a recording is one
            episode; with several policies or runs, recordings are in subfolders POLICY/run-N
            (docs/guides/recordings.md).
        failures: number of failed trips on the page `failures.html` in `out`; 0: no page.
        zones: sets zones.count, as in `make_vec`.
        backend: where the worlds run, as in `make_vec`. Results do not depend on it, except for
            `zone_imbalance`, because on nodes, vehicles change their zone only between steps. If
            other processes run the worlds, this process copies their state after each step, and the
            report lists what each process used.
        progress: called after every step of a run with the policy's name, the steps done in this
            run, and the maximum number of steps.
        watcher: called with the worlds that are stepped together; it returns a function that is
            called after each reset and step, outside of the measured time. With one run only.
        keys: keys of the world; `seed` is the seed of the first run, from which the seeds of the
            other runs follow.

    Raises:
        ConfigError: a wrong number or key, an override that contradicts a trained driver, `out`
            cannot be created, or the backend has worlds whose state cannot be copied.
        PolicyError: a policy cannot be loaded or does not fit, two have the same name, or two
            trained drivers need different sensors.
        ManifestError: `out` already holds results.
        JournalError: a journal exists already.
        RecordingError: `record` cannot be written.
        MissingExtraError: `record` without pyarrow, `failures` without Jinja2.
    """
    check_count("episodes", episodes, MAX_EPISODES)
    check_count("repeats", repeats, MAX_REPEATS)
    if watcher is not None and repeats > 1:
        raise ConfigError(
            f"repeats = {repeats} with a watcher: runs are driven in fresh processes; watch one "
            "run, or record them"
        )
    named = _named(policies)
    spec = with_sensors_of_drivers(WorldSpec.of(env, **keys), named.values())
    if zones is not None:
        spec = replace(spec, overrides={**spec.overrides, "zones.count": zones})
    if failures:
        check_count("failures", failures, MAX_FAILURES)
        require("jinja2", "report")
    job = EpisodeJob(
        **vars(spec),
        policies=named,
        episodes=episodes,
        runs=repeats,
        record=_record_options(record),
        failures=failures,
        backend=backend,
    )
    with TemporaryDirectory() as room:
        folder = Path(room) if out is None else out
        jobs, is_divided = _prepare(folder, job, repeats)
        _drive_all(folder, jobs, progress, is_divided, watcher)
        return load_report(folder)


def _record_options(record: RecordOptions | str | Path | None) -> RecordOptions | None:
    """Return the options with an absolute path, as the manifest states it.

    Raises an error before the run if no recording can be made there.
    """
    if record is None:
        return None
    require("pyarrow", "record")
    options = RecordOptions.of(record)
    path = Path(options.path).absolute()
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise RecordingError(f"{options.path}: the folder is not empty; name a new folder")
    return options.at(str(path))


def load_report(folder: Path) -> EvaluationReport:
    """Return the report of a results folder, recomputed from its raw tables.

    Raises:
        ManifestError: the manifest is missing or open (the evaluation has not ended), or a result
            is not listed in it.
    """
    manifest = read_evaluation(folder)
    speeds = json.loads((folder / SPEED_FILE).read_text(encoding="utf-8"))
    timed = {name: tuple(Speed(**run) for run in speeds[name]) for name in manifest["policies"]}
    transfers, used = load_transfers(folder), load_resources(folder)
    return make_report(load_tables(folder), timed, manifest, transfers, summaries_of(used))


def read_evaluation(folder: Path) -> dict[str, Any]:
    """Return the closed manifest of an evaluation with the metrics of this version.

    Raises ManifestError if it is missing or open, if a table is not listed or was changed, or if
    another version of the metrics was used.
    """
    manifest = read_closed(folder)
    version = manifest.get("metrics_version", 1)
    if version != METRICS_VERSION:
        raise ManifestError(
            f"{folder}: has metrics of version {version}, but this cavmarl has version "
            f"{METRICS_VERSION}; figures of different versions cannot be compared: evaluate again"
        )
    for name in (TRIPS_FILE, EPISODES_FILE):
        if name not in manifest["results_sha256"]:
            raise ManifestError(
                f"{folder / MANIFEST_FILE}: has no hash of {name}, so the table may be of another "
                "run; evaluate again"
            )
    return manifest


def load_tables(folder: Path) -> dict[str, tuple[Rows, Rows]]:
    """Return TRIP and EPISODE records by policy; raises as `load_report`."""
    names = read_evaluation(folder)["policies"]
    trips = read_table(folder / TRIPS_FILE, TRIP)
    episodes = read_table(folder / EPISODES_FILE, EPISODE)
    return {name: (trips.get(name, np.zeros(0, TRIP)), episodes[name]) for name in names}


def load_tracks(folder: Path) -> dict[str, Rows]:
    """Return TRACK records of the first episode by policy; raises as `load_report`."""
    names = read_closed(folder)["policies"]
    tracks = read_table(folder / TRACKS_FILE, TRACK)
    return {name: tracks.get(name, np.zeros(0, TRACK)) for name in names}


def load_transfers(folder: Path) -> dict[str, TransferSummary]:
    """Return transfer summaries by policy, empty for undivided worlds.

    Raises as `load_report`.
    """
    manifest = read_closed(folder)
    if TRANSFERS_FILE not in manifest["results_sha256"]:
        return {}
    rows = read_table(folder / TRANSFERS_FILE, TRANSFER)
    counts = json.loads((folder / TRANSFER_COUNTS_FILE).read_text(encoding="utf-8"))
    none = np.zeros(0, TRANSFER)
    return {
        name: TransferSummary.of(transfers_of(rows.get(name, none)), counts[name])
        for name in manifest["policies"]
    }


def load_resources(folder: Path) -> dict[str, Rows]:
    """Return RESOURCE records by policy, empty if the caller's process ran the worlds.

    Raises as `load_report`.
    """
    if RESOURCES_FILE not in read_closed(folder)["results_sha256"]:
        return {}
    return read_table(folder / RESOURCES_FILE, RESOURCE)


def load_places(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of `place_rows` by policy, empty for undivided worlds.

    Raises as `load_report`.
    """
    if PLACES_FILE not in read_closed(folder)["results_sha256"]:
        return {}
    rows: dict[str, list[dict[str, Any]]] = json.loads(
        (folder / PLACES_FILE).read_text(encoding="utf-8")
    )
    return rows


def load_map(folder: Path) -> dict[str, Any]:
    """Return the outline written by `map_outline`; raises as `load_report`."""
    read_closed(folder)
    outline: dict[str, Any] = json.loads((folder / MAP_FILE).read_text(encoding="utf-8"))
    return outline


def run_seeds(seed: int, repeats: int) -> list[int]:
    """Return the seeds of the runs: `seed` first, then hashes of (seed, run)."""
    return [derived_seed(seed, run) for run in range(repeats)]


def _named(policies: Policies) -> dict[str, str]:
    if isinstance(policies, Mapping):
        named = {name: str(policy) for name, policy in policies.items()}
    else:
        given = [policies] if isinstance(policies, str | Path) else list(policies)
        named = {str(policy): str(policy) for policy in given}
        if len(named) < len(given):
            raise PolicyError(
                f"policies {', '.join(map(str, given))}: one is listed twice; list each once"
            )
    if not named:
        raise PolicyError("there is no policy: give at least one")
    return named


def _prepare(folder: Path, job: EpisodeJob, repeats: int) -> tuple[list[EpisodeJob], bool]:
    """Check the job, then write the manifest.

    Returns the runs, and whether worlds have zones.
    """
    world = load_world(job.env, **job.keywords)
    world.tell_tolerated()
    policies = describe_policies(job.policies)
    config, network, demand, partition = world
    if obstacle := why_not_copied(config, find_backend(job.backend)):
        raise ConfigError(
            f"evaluate with {obstacle}: such worlds can only be evaluated in the caller's process; "
            "use backend='local'"
        )
    unlogged = replace(config, zones=replace(config.zones, journal=""))
    one_world = CavVectorEnv(LocalWorlds(world._replace(config=unlogged), 1))
    for policy in job.policies.values():
        load_policy(policy, one_world)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be created ({error.strerror or error})") from error
    worlds = worlds_at_once(job.episodes, config.population.agents + config.population.background)
    seeds = run_seeds(job.seed, repeats)
    jobs = _runs(job, seeds, config.zones.journal, worlds)
    processes = "this one" if repeats == 1 else "a fresh one for each run, one at a time"
    document = {
        "policies": policies,
        "episodes": job.episodes,
        "seeds": seeds,
        "job": asdict(job),
        "metrics_version": METRICS_VERSION,
        "plan": {"processes": processes, "worlds_at_once": worlds, "backend": job.backend},
        "world": describe_world(config, network, demand, partition),
    }
    open_manifest(folder, document)
    write_text(folder / MAP_FILE, json.dumps(map_outline(network)))
    return jobs, partition.count > 1


def _runs(job: EpisodeJob, seeds: list[int], journal: str, worlds: int) -> list[EpisodeJob]:
    """Return the runs of a job, each with its own journals (`run.jsonl`, `run.run-1.jsonl`, …)."""
    jobs = []
    for run, seed in enumerate(seeds):
        overrides = dict(job.overrides)
        if journal:
            path = Path(journal)
            own = path if run == 0 else path.with_suffix(f".run-{run}{path.suffix}")
            overrides["zones.journal"] = str(own)
            taken = [p for w in range(worlds) if (p := journal_path(str(own), w, worlds)).exists()]
            if taken:
                raise JournalError(f"{taken[0]}: exists; move it away, or name another journal")
        jobs.append(replace(job, seed=seed, run=run, overrides=overrides))
    return jobs


def _drive_all(
    folder: Path,
    jobs: list[EpisodeJob],
    progress: Progress | None,
    is_divided: bool,
    watcher: Watcher | None,
) -> None:
    runs: list[dict[str, RunData]] = []
    for job in jobs:
        if len(jobs) == 1:
            runs.append(drive_run(job, progress, watcher))
        else:
            what = f"run {job.run} (seed {job.seed})"
            runs.append(call_in_fresh_process(what, drive_run, job, hear=progress or _ignore))
    names = list(jobs[0].policies)
    speeds = {name: [asdict(run[name].speed) for run in runs] for name in names}
    write_table(folder / TRIPS_FILE, {n: _all(runs, n, "trips") for n in names}, TRIP)
    write_table(folder / EPISODES_FILE, {n: _all(runs, n, "episodes") for n in names}, EPISODE)
    write_table(folder / TRACKS_FILE, {name: runs[0][name].tracks for name in names}, TRACK)
    write_text(folder / SPEED_FILE, json.dumps(speeds, indent=2))
    files = list(RESULT_FILES)
    if is_divided:
        _write_places(folder, names, runs)
        files.append(PLACES_FILE)
    if is_divided and find_backend(jobs[0].backend).logs_transfers:
        _write_transfers(folder, names, runs)
        files += TRANSFER_FILES
    used = {name: _all(runs, name, "resources") for name in names}
    if any(map(len, used.values())):
        write_table(folder / RESOURCES_FILE, used, RESOURCE)
        files.append(RESOURCES_FILE)
    if jobs[0].failures:
        _write_failures(folder, jobs[0], [data for run in runs for data in run.values()])
        files.append(FAILURES_FILE)
    network = {name: list(runs[0][name].network) for name in names if runs[0][name].network}
    close_manifest(folder, files, {"network": network} if network else None)


def _write_failures(folder: Path, job: EpisodeJob, results: list[RunData]) -> None:
    world = load_world(job.env, **job.keywords)
    name = f"{world.config.name}-v{world.config.version}"
    kept = [failure for data in results for failure in data.failures]
    found = sum(int((data.trips["counted"] & ~data.trips["success"]).sum()) for data in results)
    path = folder / FAILURES_FILE
    write_failures(path, kept, job.failures, found, world.network, name)


def _ignore(policy: str, steps: int, most: int) -> None:
    """Ignore the progress."""


def _all(runs: Sequence[dict[str, RunData]], policy: str, table: str) -> Rows:
    return np.concatenate([getattr(run[policy], table) for run in runs])


def _write_transfers(folder: Path, names: list[str], runs: list[dict[str, RunData]]) -> None:
    counts: dict[str, Counter[str]] = {name: Counter() for name in names}
    for run in runs:
        for name in names:
            counts[name].update(run[name].transfer_counts)
    transfers = {name: _all(runs, name, "transfers") for name in names}
    write_table(folder / TRANSFERS_FILE, transfers, TRANSFER)
    write_text(folder / TRANSFER_COUNTS_FILE, json.dumps(counts, indent=2))


def _write_places(folder: Path, names: list[str], runs: list[dict[str, RunData]]) -> None:
    places = {
        name: place_rows(part for run in runs for part in run[name].borders) for name in names
    }
    write_text(folder / PLACES_FILE, json.dumps(places, indent=2))
