"""The reference page lists all calls, and the tutorial's program runs."""

from __future__ import annotations

import re
from pathlib import Path

from cavmarl.cosim.carla.call_table import CALLS, Effect
from cavmarl.cosim.carla.carla_server import CALL_MODULES
from tests.cosim.carla.conftest import run_client
from tests.support.generated import check_block, table

ROOT = Path(__file__).resolve().parents[3]


def test_the_page_lists_every_call() -> None:
    assert len(CALL_MODULES) == 5
    order = {effect: place for place, effect in enumerate(Effect)}
    rows = [
        (f"`{call.name}`", call.effect.value, call.note)
        for call in sorted(CALLS.values(), key=lambda call: (order[call.effect], call.name))
    ]
    page = ROOT / "docs/reference/carla_client.md"
    check_block(page, "calls", table(("call", "effect", "remarks"), rows))


def test_the_program_of_the_tutorial_runs(port: int) -> None:
    page = (ROOT / "docs/tutorials/carla_client.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```py\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    program = "".join(blocks).replace("2000", "int(sys.argv[1])").replace("8000", "8321")
    found = run_client(port, program + "\nfound['agents'] = len(agents)\n")
    assert found == {"agents": 3}
