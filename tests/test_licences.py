"""The table of licences has all installed packages, and `hashes.txt` fits the constraints."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from docs.supply_chain import LOCKED, licences
from tests.support.generated import check_block

ROOT = Path(__file__).resolve().parents[1]


def test_the_table_of_licences_has_each_installed_package() -> None:
    rows = list(licences())
    if not {"ray", "torchrl", "stable-baselines3"} <= {name for name, *_ in rows}:
        pytest.skip("parts of cavmarl[dev] are not installed: `make test` has all of them")
    lines = ["| package | needed by | licence |", "|---|---|---|"]
    lines += ["| {} |".format(" | ".join(row)) for row in rows]
    check_block(ROOT / "docs" / "reference" / "licences.md", "licences", "\n".join(lines))


def test_the_versions_with_hashes_equal_the_constraints() -> None:
    exact = dict(
        line.lower().replace("_", "-").split("==")
        for line in (ROOT / "constraints/exact.txt").read_text().splitlines()
        if not line.startswith("#")
    )
    locked = [
        re.fullmatch(r"([a-z0-9-]+)==(\S+) --hash=sha256:[0-9a-f]{64}", line)
        for line in (ROOT / "constraints/hashes.txt").read_text().splitlines()
        if not line.startswith("#")
    ]
    assert all(locked)
    assert all(exact[found[1]] == found[2] for found in locked if found is not None)
    names = {found[1] for found in locked if found is not None}
    needed = {
        name
        for name, extras, _ in licences()
        if {*extras.split(", ")} & {"cavmarl", *LOCKED.split(",")}
    }
    assert needed <= names
