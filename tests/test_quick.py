"""`make quick` runs at least the first test file, and fails if no test ran."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.tiers import TimeLimit
from tests.support.touched import RunCount

pytest_plugins = ["pytester"]

ROOT = Path(__file__).resolve().parents[1]


def test_after_the_time_limit_only_the_first_file_runs(pytester: pytest.Pytester) -> None:
    first = pytester.makepyfile(test_b="def test_one(): pass\ndef test_two(): pass\n")
    second = pytester.makepyfile(test_a="def test_three(): pass\n")
    count = RunCount()
    found = pytester.inline_run(str(first), str(second), plugins=[TimeLimit(-1.0), count])
    found.assertoutcome(passed=2, skipped=1)
    assert count.tests == 2


def test_a_run_without_a_test_is_an_error(tmp_path: Path) -> None:
    file = tmp_path / "test_skipped.py"
    file.write_text("import pytest\ndef test_one(): pytest.skip('why')\n", encoding="utf-8")
    run = (
        f"from tests.support.touched import run; raise SystemExit(run([{str(file)!r}], 'not slow'))"
    )
    done = subprocess.run(
        [sys.executable, "-c", run], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode != 0
    assert "no test ran: run `make test`" in done.stderr
