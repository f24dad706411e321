from __future__ import annotations

import re
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cavmarl.config.registry import agent_entries
from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.evaluate import EvaluationReport
from cavmarl.evaluate.report import make_report
from cavmarl.evaluate.tables import EPISODE, TRIP
from tests.record.__main__ import block_tests, tables_named
from tests.record.figures import (
    by_map,
    difference,
    distance_per_infraction,
    number,
    share,
    trips,
    worst_map,
)
from tests.record.jobs import (
    EVALUATE,
    ROOT,
    drivers_of,
    finish_all,
    jobs_of,
    options_of,
    results_folder,
)
from tests.record.score_tables import DELAY, TABLES, Results, drivers_table, shares
from tests.support.generated import read_block, write_block

COMMAND = "cavmarl evaluate merge -p idm -p blind -n 2 --seed 7"
each_table = pytest.mark.parametrize("table", TABLES, ids=lambda table: table.name)


def fake_report(runs: int = 1, collisions: int = 1) -> EvaluationReport:
    """Return a report with 40 trips per run on two maps; 38 of them arrive if none collide."""
    rows, episodes = np.zeros(40 * runs, TRIP), np.zeros(2 * runs, EPISODE)
    number_in_run = np.arange(40 * runs) % 40
    rows["run"], episodes["run"] = np.arange(40 * runs) // 40, np.arange(2 * runs) // 2
    rows["map"] = number_in_run % 2
    rows["counted"] = True
    rows["collision"] = number_in_run < collisions + rows["run"]
    rows["arrived"] = ~rows["collision"] & (number_in_run < 38)
    rows["success"] = rows["arrived"]
    rows["delay_s"] = 3.0 + rows["run"]
    rows["distance_m"] = 40_000.0
    manifest = {"seeds": [*range(runs)], "episodes": 2, "world": {"maps": ["east", "west"]}}
    return make_report({"driver": (rows, episodes)}, {"driver": ()}, manifest, {}, {})


def test_each_trained_driver_has_a_table_of_scores_in_its_card() -> None:
    for name, path in agent_entries().items():
        if path.is_dir():
            (table,) = tables_named([f"agents/{name}/README.md:scores"])
            assert name in {driver for line in table.commands for driver in drivers_of(line)}


def test_each_block_of_a_drivers_card_is_recorded() -> None:
    cards = sorted(ROOT.glob("agents/*/README.md"))
    assert len(cards) > 10
    for card in cards:
        blocks = re.findall(r"<!-- (?!end )(.+?) -->", card.read_text("utf-8"))
        page = card.relative_to(ROOT).as_posix()
        recorded = [table.block for table in TABLES if table.page == page]
        assert sorted(blocks) == sorted([*recorded, "reads"]), (
            page
        )  # for `reads`, see test_cards.py


@each_table
def test_a_page_shows_the_commands_of_its_table(table: Any) -> None:
    text = " ".join((ROOT / table.page).read_text("utf-8").split())
    for command in table.shown:
        assert f"`{command}`" in text, command
    assert read_block(ROOT / table.page, table.block).startswith("| ")


@each_table
def test_each_command_of_a_table_has_jobs(table: Any) -> None:
    for command in table.commands:
        options = options_of(command)
        if command.startswith(EVALUATE):
            jobs = jobs_of(command)
            assert list(jobs) == options["policy"]
            assert {job.world.seed for job in jobs.values()} == {options["seed"]}
    assert len({job.key for job in table.jobs}) >= len(table.commands)


def test_tables_that_show_the_same_driver_share_its_jobs() -> None:
    (card,) = tables_named(["agents/exit_ippo/README.md"])
    (all_tasks,) = tables_named(["docs/figures/tasks.md:trained drivers"])
    assert {job.key for job in card.jobs} < {job.key for job in all_tasks.jobs}


def test_a_table_shows_the_figures_of_a_small_result() -> None:
    idm, blind = (job.key for job in jobs_of(COMMAND).values())
    results = Results({idm: fake_report(collisions=0), blind: fake_report()})
    columns = [("idm", COMMAND, "idm"), ("other", COMMAND, "blind")]
    rows = [("trips", trips), *shares("arrived", "off_road"), *shares("collision", decimals=2)]
    rows += [("way per infraction", distance_per_infraction), DELAY]
    assert drivers_table(columns, rows, results) == "\n".join(
        [
            "|  | idm | other |",
            "| --- | ---: | ---: |",
            "| trips | 40 | 40 |",
            "| arrived | 95.0 % [83.5, 98.6] | 92.5 % [80.1, 97.4] |",
            "| off road | 0.0 % [0.0, 8.8] | 0.0 % [0.0, 8.8] |",
            "| collision | 0.00 % [0.0, 8.8] | 2.50 % [0.4, 12.9] |",
            "| way per infraction | 1,600 km | 1,600 km |",
            "| delay of an arrival | 3.0 s | 3.0 s |",
        ]
    )


def test_figures_of_several_runs_have_intervals_between_runs() -> None:
    report = fake_report(runs=3)
    assert DELAY[1](report) == "4.0 s ± 2.5"
    assert share("collision")(report) == "5.0 % [1.5, 15.2]"
    assert difference("collision", report, fake_report(runs=3, collisions=0)) == "2.5"


def test_maps_are_sorted_by_success() -> None:
    report = fake_report()
    assert worst_map(report) == "90.0 % (`east`)"
    assert list(by_map(report)) == ["east", "west"]
    assert by_map(report)["east"]["collision"] == "5.0 %"


def test_a_small_positive_number_is_not_shown_as_0() -> None:
    shown = [number(value, 1) for value in (0.0, 0.04, 0.06, 1234.56)]
    assert shown == ["0.0", "0.04", "0.1", "1,234.6"]
    assert number(0.04, 0) == "0"


@dataclass(frozen=True)
class FailingJob:
    """A job that fails after it has begun to write."""

    key: str = "failing"

    def drive(self, out: Path) -> None:
        out.mkdir()
        (out / "rows.json").write_text("{")
        raise ConfigError("a world that cannot be made")


def test_a_failed_job_stops_the_recording_and_leaves_no_files(tmp_path: Path) -> None:
    job: Any = FailingJob()
    with pytest.raises(ConfigError, match="cannot be made"):
        finish_all([job], 1, print, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_existing_results_are_not_computed_again(tmp_path: Path) -> None:
    (tmp_path / "failing").mkdir()

    @dataclass(frozen=True)
    class FinishedJob(FailingJob):
        def load(self, folder: Path) -> str:
            return folder.name

    job: Any = FinishedJob()
    assert finish_all([job], 1, print, tmp_path) == {"failing": "failing"}


def test_the_error_for_a_page_without_scores_lists_pages_with_scores() -> None:
    page = "docs/guides/bring_a_map.md"
    with pytest.raises(CavmarlError, match=rf"{page}.*(?s:.*)docs/figures/tasks\.md:tasks"):
        tables_named([page])


def test_writing_a_block_keeps_the_rest_of_the_page(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- scores -->\n| old |\n<!-- end -->\nafter\n", "utf-8")
    write_block(page, "scores", "| ± |")
    assert page.read_text("utf-8") == "before\n<!-- scores -->\n| ± |\n<!-- end -->\nafter\n"
    assert list(tmp_path.iterdir()) == [page]


def test_the_tests_that_write_blocks_are_found() -> None:
    found = block_tests()
    assert "tests/test_cards.py::test_a_card_has_the_table_of_observations" in found
    assert all("::test_" in name for name in found)


@pytest.mark.slow
@pytest.mark.parametrize("page", ["agents/exit_ippo/README.md", "README.md"])
def test_a_table_that_is_recorded_again_equals_its_page(page: str, tmp_path: Path) -> None:
    (table,) = tables_named([page])
    tell = partial(print, flush=True)
    text = table.write(Results(finish_all(table.jobs, 2, tell, tmp_path)))
    assert text == read_block(ROOT / table.page, table.block)
    assert results_folder().parent.name == "record"
