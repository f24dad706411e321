"""Progress bars: their contents, and no output without a terminal."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from cavmarl.core.progress import counting, in_stages


def test_a_bar_shows_the_stage_and_the_remaining_time() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=120, color_system=None)
    with in_stages(console, ["reading", "netconvert", "checks"]) as report:
        report("reading")
        report("checks")
    shown = console.file.getvalue()
    assert "checks" in shown
    assert "2/3" in shown
    assert "left" in shown


def test_an_unknown_stage_is_an_error() -> None:
    with in_stages(Console(file=io.StringIO()), ["reading"]) as report:
        with pytest.raises(ValueError, match="writing"):
            report("writing")


def test_without_a_terminal_nothing_is_written() -> None:
    console = Console(file=io.StringIO(), width=120)
    with in_stages(console, ["reading", "checks"]) as report:
        report("checks")
    with counting(console, "steps") as count:
        count(1, 2)
    assert console.file.getvalue() == ""
