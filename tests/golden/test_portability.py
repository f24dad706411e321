"""Worlds and drivers compute the same bytes on every processor that this machine can imitate."""

from __future__ import annotations

import pytest

from tests.golden import portability
from tests.golden.portability import PROCESSORS, QUICK, QUICK_TASKS, TASKS, Processor, compare


def test_results_do_not_depend_on_numpy_or_the_c_library(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert compare(QUICK, QUICK_TASKS) == 0, capsys.readouterr().out
    assert capsys.readouterr().out.count("same") >= 2


@pytest.mark.slow
def test_results_do_not_depend_on_the_processor(capsys: pytest.CaptureFixture[str]) -> None:
    assert compare(PROCESSORS, TASKS) == 0, capsys.readouterr().out
    with capsys.disabled():  # the result names the skipped processors
        print(capsys.readouterr().out)


def test_a_difference_is_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    processors = {name: Processor({"CASE": name}) for name in ("other", "failing")}
    found = {"": [{"states": "1"}], "other": [{"states": "2"}], "failing": [{"error": "no memory"}]}
    monkeypatch.setattr(portability, "PROCESSORS", processors)
    monkeypatch.setattr(
        portability, "hashes", lambda processor, *_: iter(found[processor.settings.get("CASE", "")])
    )
    assert compare(processors, ("two",)) == 1
    other, failing = capsys.readouterr().out.splitlines()
    assert other.endswith("DIFFERENT: states")
    assert failing.endswith("DIFFERENT: no memory")
