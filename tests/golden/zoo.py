"""Record the results of the trained drivers and of the board again.

    python -m tests.golden.zoo [DRIVER ...]

This command evaluates the named drivers, or all trained drivers and the drivers of `board/`, and
replaces their folders `result/`. Run it at the root of the repository. The world, seed, episodes
and runs of each evaluation come from the manifest of the old result. The command is the part `zoo`
of `make record` (CONTRIBUTING.md). It stops at the first driver that cannot be recorded.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cavmarl.config.driver_form import WEIGHTS_FILE
from cavmarl.config.registry import agent_entries
from cavmarl.core.atomic_file import draft_folder
from cavmarl.core.errors import CavmarlError
from cavmarl.evaluate.evaluation import load_report
from cavmarl.evaluate.provenance.manifest import read_closed
from cavmarl.evaluate.zoo import RESULT_FOLDER, TABLES, entry_job
from cavmarl.policies.loading import policy_files

BOARD = Path(__file__).resolve().parents[2] / "board"
SAME, OTHER = "same results as before", "recorded anew"


def record(driver: str | Path) -> str:
    """Replace the result of a driver, given by its name or folder; return a word for the outcome.

    The result of a driver in a script is in `board/`.

    The old result stays if the new one is the same, or if the evaluation fails or is interrupted.
    """
    files = policy_files(driver)
    folder = files[0].parent if len(files) > 1 else BOARD / str(driver)
    result = folder / RESULT_FOLDER
    before = read_closed(result)
    with draft_folder(folder) as draft:
        made, old = draft / RESULT_FOLDER, draft / "old"
        # Do not replace a name by a path, which would depend on this machine.
        entry_job(before, folder).drive(next(iter(before["policies"])), Path(driver), made)
        load_report(made)
        found = read_closed(made)
        if _facts(found) == _facts(before):
            return SAME
        result.rename(old)
        try:
            made.rename(result)
        except OSError:
            old.rename(result)
            raise
    return OTHER


def _facts(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return the part of a manifest that depends on neither time, machine nor code version."""
    keys = ("schema", "metrics_version", "episodes", "seeds")
    return {
        **{key: document.get(key) for key in keys},
        "world": {key: value for key, value in document["world"].items() if key != "kernels"},
        "policies": [policy["sha256"] for policy in document["policies"].values()],
        "tables": {name: document["results_sha256"].get(name) for name in TABLES},
    }


def main() -> int:
    """Record the results of drivers; return 1 if one of them cannot be recorded."""
    drivers = [name for name, path in sorted(agent_entries().items()) if path.is_dir()]
    entries = sorted(path.parent for path in BOARD.glob(f"*/{RESULT_FOLDER}"))
    is_trained = {entry: (entry / WEIGHTS_FILE).is_file() for entry in entries}
    drivers += [f"board/{one.name}" if is_trained[one] else one.name for one in entries]
    parser = argparse.ArgumentParser(description=f"Drivers: {' '.join(drivers)}")
    parser.add_argument("drivers", nargs="*", metavar="DRIVER")
    has_failed = False
    for name in parser.parse_args().drivers or drivers:
        try:
            said = record(name)
        except CavmarlError as error:
            said, has_failed = f"FAILED: {error}", True
        print(f"{name:32} {said}", flush=True)
        if has_failed:
            break
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main())
