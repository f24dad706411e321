"""Results of the zoo, made again: for each trained driver, `result/` is driven anew and replaced.

    python -m tests.golden.zoo [DRIVER ...]

evaluates each driver (all, if none is named) with the job in the manifest of its result: the same
world, seed, episodes and runs. Use it after a change of behaviour, then rewrite the tables of the
cards (CONTRIBUTING.md).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from cavmarl.config.registry import agent_entries
from cavmarl.core.errors import CavmarlError
from cavmarl.core.whole_file import draft_folder
from cavmarl.evaluate.evaluation import load_report
from cavmarl.evaluate.provenance.manifest import read_closed
from cavmarl.evaluate.zoo import RESULT_FOLDER, TABLES, entry_job
from cavmarl.policies.policy import policy_files

SAME, OTHER = "same bytes as before", "recorded anew"


def record(driver: str | Path) -> str:
    """Replace the result of a driver, given by its name or folder; return what has become of it.

    The old result stays if the evaluation fails or is interrupted.
    """
    folder = policy_files(driver)[0].parent
    result = folder / RESULT_FOLDER
    before = read_closed(result)
    with draft_folder(folder) as draft:
        made, old = draft / RESULT_FOLDER, draft / "old"
        entry_job(before, folder).drive(next(iter(before["policies"])), folder, made)
        load_report(made)
        result.rename(old)
        try:
            made.rename(result)
        except OSError:
            old.rename(result)
            raise
    found = read_closed(result)["results_sha256"]
    is_same = all(found.get(name) == before["results_sha256"].get(name) for name in TABLES)
    return SAME if is_same else OTHER


def main() -> int:
    """Record the results of drivers; return 1 if one of them cannot be recorded."""
    drivers = [name for name, path in sorted(agent_entries().items()) if path.is_dir()]
    parser = argparse.ArgumentParser(description=f"Drivers: {' '.join(drivers)}")
    parser.add_argument("drivers", nargs="*", metavar="DRIVER")
    has_failed = False
    for name in parser.parse_args().drivers or drivers:
        try:
            said = record(name)
        except CavmarlError as error:
            said, has_failed = f"FAILED: {error}", True
        print(f"{name:32} {said}", flush=True)
    return int(has_failed)


if __name__ == "__main__":
    sys.exit(main())
