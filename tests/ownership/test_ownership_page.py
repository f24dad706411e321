"""Generate the tables and diagrams of docs/explanation/ownership.md from the code."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from cavmarl.ownership.codec import KINDS as MESSAGES
from cavmarl.ownership.log_records import KINDS as RECORDS
from cavmarl.ownership.messages import (
    COORDINATOR,
    Begin,
    Commit,
    Message,
    Output,
    Prepare,
    Record,
    Step,
)
from cavmarl.ownership.transitions import Party, mermaid
from tests.ownership import test_border_rules, test_rules
from tests.ownership.bench import Bench
from tests.ownership.scenarios import SCENARIOS
from tests.support.generated import check_block, table

NAMES = {0: "Source", COORDINATOR: "Coordinator", 1: "Target"}  # party → name in the diagram
PAGE = Path(__file__).resolve().parents[2] / "docs/explanation/ownership.md"


def meaning(kind: object) -> str:
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def own_fields(kind: type, base: type) -> str:
    inherited = {field.name for field in fields(base)}
    return ", ".join(f"`{f.name}`" for f in fields(kind) if f.name not in inherited)


def test_the_page_lists_every_message() -> None:
    rows = [(kind.__name__.upper(), meaning(kind), own_fields(kind, Message)) for kind in MESSAGES]
    check_block(PAGE, "messages", table(("message", "from → to: meaning", "fields"), rows))


def test_the_page_lists_every_record() -> None:
    rows = [(name, meaning(kind), own_fields(kind, Record)) for name, kind in RECORDS.items()]
    check_block(PAGE, "records", table(("record", "meaning", "fields"), rows))


def test_the_page_shows_every_transition() -> None:
    parts = [f"{party.value.capitalize()}:\n\n```mermaid\n{mermaid(party)}\n```" for party in Party]
    check_block(PAGE, "diagrams", "\n\n".join(parts))


class Drawn(Bench):
    """A run that draws its messages and records as a Mermaid diagram."""

    def __init__(self) -> None:
        self.lines = ["sequenceDiagram", *(f"    participant {name}" for name in NAMES.values())]
        super().__init__()

    def give(self, message: Message, removed: Sequence[int] = ()) -> tuple[Message, ...]:
        sender = getattr(message, "source" if isinstance(message, Prepare) else "zone", COORDINATOR)
        sender = COORDINATOR if isinstance(message, Step) else sender
        label = type(message).__name__.upper()
        if isinstance(message, Step):
            label += "".join(f", {word}" for word in ("OUT", "IN") if word in _lists(message))
        for place in message.destinations():
            self.lines.append(f"    {NAMES[sender]}->>{NAMES[place]}: {label}")
        return super().give(message, removed)

    def note(self, output: Output) -> Output:
        for record in output.records:
            if isinstance(record, Begin | Commit):
                name = type(record).__name__.upper()
                self.lines.append(f"    Note over {NAMES[COORDINATOR]}: {name} {record.tick}")
        return super().note(output)


def _lists(step: Step) -> set[str]:
    return {word for word, moves in (("IN", step.enter), ("OUT", step.leave)) if moves}


def test_the_page_draws_a_hand_off() -> None:
    drawn = Drawn()
    drawn.tick(births=[(7, 0)])
    first = len(drawn.lines)
    drawn.tick(offers=[(7, 1)])
    drawn.tick(movers=[(7, 1)])
    assert drawn.owner(7) == 1
    lines = [*drawn.lines[: 1 + len(NAMES)], *drawn.lines[first:]]
    check_block(PAGE, "handoff", "\n".join(["```mermaid", *lines, "```"]))


def test_the_page_lists_every_remedy() -> None:
    told = [(meaning(scenario).rstrip("."), name) for name, scenario in SCENARIOS.items()]
    rows = [(*text.split(": ", 1), f"`{name}`") for text, name in told]
    check_block(PAGE, "remedies", table(("hole", "remedy", "scenario"), rows))


def test_the_program_of_the_page_runs() -> None:
    program, *_ = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(compile(program, str(PAGE), "exec"), {})


def test_the_page_and_the_tests_have_the_same_rules() -> None:
    text = PAGE.read_text(encoding="utf-8")
    listed = re.findall(r"^\| R(\d+) \|.*\| `(\w+)` \|$", text, re.MULTILINE)
    both = [*vars(test_rules), *vars(test_border_rules)]
    tests = sorted(filter(re.compile(r"test_r\d\d_").match, both), key=lambda name: name[:8])
    assert [name for _, name in listed] == [name for name in tests if name in text]
    assert {number for number, _ in listed} == {str(int(name[6:8])) for name in tests}
    assert all(name.startswith(f"test_r{int(number):02}_") for number, name in listed)
