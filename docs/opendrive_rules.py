"""Check OpenDRIVE files with ASAM's own checker: 23 rules of the versions 1.7 and 1.8.

.venv-tools/bin/python -m docs.opendrive_rules FILE.xodr …   # `make rules` creates the environment

Each rule is checked with the version for which it is defined; a file passes if it breaks no rule.
"""

from __future__ import annotations

import logging
import re
import sys
import tempfile
from pathlib import Path

from qc_baselib import Configuration, Result
from qc_opendrive import constants
from qc_opendrive.main import run_checks

MINOR_VERSIONS = (7, 8)  # one rule exists up to 1.7, another one from 1.8 on


def broken_rules(path: Path) -> dict[str, tuple[int, int]]:
    """Return how often each rule was checked for a file, and how often the file breaks it."""
    text = path.read_text(encoding="utf-8")
    found: dict[str, tuple[int, int]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for minor in MINOR_VERSIONS:
            copy = Path(folder) / f"1.{minor}.xodr"
            copy.write_text(re.sub(r'revMinor="\d+"', f'revMinor="{minor}"', text, count=1))
            for checker in _result(copy)._report_results.checker_bundles[0].checkers:
                done = str(checker.status).endswith("COMPLETED")
                asked, broken = found.get(checker.checker_id, (0, 0))
                found[checker.checker_id] = (asked + done, broken + len(checker.issues))
    return found


def _result(path: Path) -> Result:
    logging.disable(logging.CRITICAL)
    config, result = Configuration(), Result()
    config.set_config_param("InputFile", str(path))
    result.register_checker_bundle("", constants.BUNDLE_NAME, constants.BUNDLE_VERSION)
    result.set_result_version(constants.BUNDLE_VERSION)
    run_checks(config, result)
    return result


def main(paths: list[str]) -> int:
    """Print a line per file; exit with 1 if a file breaks a rule, or a rule was not checked."""
    sound = bool(paths)
    for path in map(Path, paths):
        found = broken_rules(path)
        missed = sum(asked == 0 for asked, _ in found.values())
        issues = sum(broken for _, broken in found.values())
        print(f"{path}: {len(found) - missed} of {len(found)} rules checked, {issues} violations")
        for rule, (_, broken) in found.items():
            if broken:
                print(f"  {rule}: {broken}")
        sound &= not missed and not issues
    return 0 if sound else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
