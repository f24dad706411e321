"""Changes of a map's signal programs: additional files, timetables, or explicit choices."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cavmarl.core.errors import MapError
from cavmarl.roads.network import RoadNetwork
from cavmarl.roads.sumo_net.detectors import DetectorRoads, place_detectors
from cavmarl.roads.sumo_net.programs import (
    OFF,
    ProgramPhase,
    SignalProgram,
    Timetable,
    read_programs,
)
from cavmarl.roads.sumo_net.reader import source_hash
from cavmarl.roads.sumo_net.signal_rows import SignalRows


def with_programs(
    network: RoadNetwork, files: Sequence[Path] = (), chosen: Mapping[str, str] | None = None
) -> RoadNetwork:
    """Return a network whose signals also have the programs of additional files.

    As in SUMO, the program that is loaded last runs, and every signal has a program `off`. A <WAUT>
    gives the times at which signals switch programs. Signals switch at once, in any phase, and the
    time of every program starts with the episode. `chosen` overrides files and timetables.

    `files`: additional files in loading order; elements that do not concern signals are ignored.
    `chosen`: programs by signal.

    Returns a network whose `source_hash` covers all sources. Raises MapError: a file is broken, a
    signal or program is unknown, or a program does not fit its signal.
    """
    chosen = chosen or {}
    if not files and not chosen:
        return network
    rows = SignalRows.of(network)
    sources = [network.source_hash, *(f"{name}={to}" for name, to in sorted(chosen.items()))]
    for path in files:
        found = read_programs(path)
        for program in found.programs:
            _check_signal(rows, program.signal_id, program.place)
            off = program.program_id == OFF
            rows.add(_off(network, rows, program.signal_id) if off else program)
        for timetable in found.timetables.values():
            _follow(network, rows, timetable)
        sources.append(source_hash(path))
    for signal_id, program_id in chosen.items():
        _check_signal(rows, signal_id, "map.program")
        row = rows.row[signal_id]
        rows.signals[row][0] = _program(network, rows, signal_id, program_id, "map.program")
        rows.switches = [switch for switch in rows.switches if switch[0] != row]
    return remade(network, rows, sources)


def with_outages(network: RoadNetwork, outages: Mapping[str, float]) -> RoadNetwork:
    """Return a network with signals that fail during the episode and stay off.

    Failed signals switch to their program `off`; links with a duty to yield blink.

    `outages`: time of failure by signal, in s since the beginning of the episode.

    Returns a network with a new `source_hash`. Raises MapError: a signal is unknown.
    """
    rows = SignalRows.of(network)
    sources = [network.source_hash]
    for signal_id, at_s in sorted(outages.items()):
        _check_signal(rows, signal_id, "outage")
        row = rows.row[signal_id]
        # `_program` may append a program, which would run at once; restore the present program.
        present = rows.signals[row][0]
        off = _program(network, rows, signal_id, OFF, "outage")
        rows.signals[row][0] = present
        earlier = [s for s in rows.switches if s[0] != row or s[1] < at_s]
        rows.switches = [*earlier, (row, at_s, off)]
        sources.append(f"{signal_id} off at {at_s!r}")
    return remade(network, rows, sources)


def remade(network: RoadNetwork, rows: SignalRows, sources: Sequence[str]) -> RoadNetwork:
    """Return a network with other signals, and with the detectors that their programs need.

    `sources`: texts that the new `source_hash` covers.
    """
    roads = DetectorRoads(
        network.lanes,
        network.edges,
        network.links,
        network.conflicts,
        network.into,
        network.lane_ids,
    )
    detectors, phase_detectors = place_detectors(rows, roads, len(network.detectors))
    return replace(
        network,
        source_hash=hashlib.sha256("\0".join(sources).encode()).hexdigest(),
        **rows.arrays()._asdict(),
        detectors=np.concatenate([network.detectors, detectors]),
        phase_detectors=phase_detectors,
    )


def _follow(network: RoadNetwork, rows: SignalRows, timetable: Timetable) -> None:
    for signal_id in timetable.signal_ids:
        _check_signal(rows, signal_id, timetable.place)
        row = rows.row[signal_id]

        def program(name: str, signal_id: str = signal_id) -> int:
            return _program(network, rows, signal_id, name, timetable.place)

        switches = [(row, time, program(to)) for time, to in timetable.switches]
        others = [switch for switch in rows.switches if switch[0] != row]
        rows.switches = others + switches
        rows.signals[row][0] = program(timetable.start)


def _program(
    network: RoadNetwork, rows: SignalRows, signal_id: str, program_id: str, place: str
) -> int:
    """Return the PROGRAM row of a name; create the program `off` if it is needed."""
    if program_id == OFF and (signal_id, OFF) not in rows.program_row:
        rows.add(_off(network, rows, signal_id))
    if (signal_id, program_id) not in rows.program_row:
        known = sorted({name for signal, name in rows.program_row if signal == signal_id} | {OFF})
        raise MapError(
            f"{place}: signal '{signal_id}' has no program '{program_id}'; "
            f"use one of {', '.join(known)}"
        )
    return rows.program_row[signal_id, program_id]


def _off(network: RoadNetwork, rows: SignalRows, signal_id: str) -> SignalProgram:
    """Return the program of a failed signal: links that yield show blinking, others are off."""
    row = rows.row[signal_id]
    letters = ["O"] * rows.signals[row][1]
    for link in network.links[network.links["signal"] == row]:
        if link["state"] == ord("o"):
            letters[link["signal_index"]] = "o"
    phase = ProgramPhase(1.0, 1.0, 1.0, "".join(letters))
    return SignalProgram(signal_id, OFF, "static", 0.0, OFF, [phase])


def _check_signal(rows: SignalRows, signal_id: str, place: str) -> None:
    if signal_id not in rows.row:
        known = ", ".join(sorted(rows.ids)[:8]) or "none"
        raise MapError(
            f"{place}: this map has no signal '{signal_id}', only {known}: "
            "check that the file is for this map"
        )
