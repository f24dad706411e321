"""Merges evaluations of single runs, made on different nodes, into one evaluation."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cavmarl.core.errors import ManifestError
from cavmarl.evaluate.evaluation import (
    EPISODES_FILE,
    MAP_FILE,
    RESULT_FILES,
    SPEED_FILE,
    TRACKS_FILE,
    TRIPS_FILE,
    read_evaluation,
)
from cavmarl.evaluate.provenance.manifest import close_manifest, open_manifest, write_text
from cavmarl.evaluate.tables import EPISODE, TRACK, TRIP, read_table, write_table

# Parts of the manifest that all runs must have in common.
COMMON = ("policies", "episodes", "metrics_version", "world")


def merge_runs(parts: Sequence[Path], out: Path) -> None:
    """Write the results of several evaluations of one run each as runs 0, 1, … of one evaluation.

    Tables equal those of `evaluate(…, repeats=len(parts))` with the same seeds. The manifest keeps
    the manifests of the parts under `parts`.

    Args:
        parts: results folders of the runs, in their order.
        out: folder of the merged results; it exists and holds no results.

    Raises:
        ManifestError: a part is not closed, has several runs, is of another world or policy than
            the first part, or has tables of zones; or `out` holds results.
    """
    manifests = [read_evaluation(part) for part in parts]
    first = manifests[0]
    for part, manifest in zip(parts, manifests, strict=True):
        if len(manifest["seeds"]) != 1:
            raise ManifestError(f"{part}: has {len(manifest['seeds'])} runs; merge single runs")
        if differing := [key for key in COMMON if manifest[key] != first[key]]:
            raise ManifestError(
                f"{part}: its {differing[0]} differs from that of {parts[0]}; merge runs of the "
                "same evaluation, made by the same version of cavmarl"
            )
        if more := sorted(set(manifest["results_sha256"]) - set(RESULT_FILES)):
            raise ManifestError(
                f"{part}: has {more[0]}, which cannot be merged; merge runs of undivided worlds, "
                "without failures"
            )
    document: dict[str, Any] = {key: first[key] for key in COMMON}
    document |= {
        "seeds": [manifest["seeds"][0] for manifest in manifests],
        "job": first["job"] | {"runs": len(parts)},
        "plan": {"processes": "one for each run, on the machines of `parts`"},
        "parts": manifests,
    }
    open_manifest(out, document)
    for name, dtype in ((TRIPS_FILE, TRIP), (EPISODES_FILE, EPISODE)):
        tables = [read_table(part / name, dtype) for part in parts]
        for run, table in enumerate(tables):
            for rows in table.values():
                rows["run"] = run
        none = np.zeros(0, dtype)
        merged = {
            policy: np.concatenate([table.get(policy, none) for table in tables])
            for policy in first["policies"]
        }
        write_table(out / name, merged, dtype)
    write_table(out / TRACKS_FILE, read_table(parts[0] / TRACKS_FILE, TRACK), TRACK)
    write_text(out / MAP_FILE, (parts[0] / MAP_FILE).read_text(encoding="utf-8"))
    speeds = [json.loads((part / SPEED_FILE).read_text(encoding="utf-8")) for part in parts]
    joined = {name: [run for speed in speeds for run in speed[name]] for name in first["policies"]}
    write_text(out / SPEED_FILE, json.dumps(joined, indent=2))
    close_manifest(out, list(RESULT_FILES))
