"""The tables of scores: their page and block, the commands beside them, and their cells.

A command with a word of `PLACEHOLDERS` stands for several commands: the word is replaced by each
name of the table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from tests.record.figures import (
    NONE,
    Figure,
    by_map,
    difference,
    distance_per_infraction,
    figure,
    share,
    trips,
    worst_map,
)
from tests.record.jobs import AnyJob, drivers_of, jobs_of
from tests.support.generated import table

PLACEHOLDERS = ("NAME", "LOSS", "SEED")
ALONE = "--agents 1 --background 0"
TASKS = ("exit", "bottleneck", "tollgate", "intersection", "roundabout", "two-way", "u-turn")
TASKS += ("highway",)
SCRIPTED_TASKS = ("intersection", "roundabout", "bottleneck", "tollgate", "exit")
SCRIPTED_TASKS += ("blind_junction", "two-way", "u-turn", "highway")

Rows = Sequence[tuple[str, Figure]]
Column = tuple[str, str, str]  # title, command, driver


@dataclass(frozen=True)
class Results:
    """The results of the jobs, by key."""

    by_key: Mapping[str, Any]

    def of(self, command: str, driver: str) -> Any:
        """Return the report on a driver that a command evaluates."""
        return self.by_key[jobs_of(command)[driver].key]


@dataclass(frozen=True)
class ScoreTable:
    """A block of a page with a table of results of commands.

    Attributes:
        page: path of the page in the repository.
        block: name of the block, which is between `<!--` and `-->`.
        shown: the commands as the page shows them.
        write: returns the text of the block for the results.
        names: the names that replace the placeholder in a command.
    """

    page: str
    block: str
    shown: Sequence[str]
    write: Callable[[Results], str]
    names: Sequence[str] = field(default=("",))

    @property
    def name(self) -> str:
        """Page and block, as given on the command line of a recording."""
        return f"{self.page}:{self.block}"

    @property
    def commands(self) -> list[str]:
        """All commands, with names in the place of placeholders."""
        return list(
            dict.fromkeys(filled_in(text, name) for text in self.shown for name in self.names)
        )

    @property
    def jobs(self) -> Iterator[AnyJob]:
        """The jobs of all commands."""
        for command in self.commands:
            yield from jobs_of(command).values()


def filled_in(command: str, name: str) -> str:
    """Return a command with a name in the place of the placeholder.

    A name of an environment with `-` becomes the name of a driver with `_`.
    """
    text = command.replace("NAME_ippo", f"{name.replace('-', '_')}_ippo")
    for word in PLACEHOLDERS:
        text = text.replace(word, name)
    return text


def drivers_table(columns: Sequence[Column], rows: Rows, results: Results) -> str:
    """Return a table with a column for each driver, and a row for each figure."""
    reports = [results.of(command, driver) for _, command, driver in columns]
    lines = [(title, *map(write, reports)) for title, write in rows]
    return table(("", *(title for title, _, _ in columns)), lines, is_right=True)


def columns_of(command: str, *more: Column) -> list[Column]:
    """Return a column for each driver of a command, and the columns `more`."""
    return [*((driver, command, driver) for driver in drivers_of(command)), *more]


def maps_table(command: str, columns: Sequence[tuple[str, str, str]], results: Results) -> str:
    """Return a table with a row for each map; columns are (title, driver, share)."""
    drivers = dict.fromkeys(driver for _, driver, _ in columns)
    maps = {driver: by_map(results.of(command, driver)) for driver in drivers}
    lines = [
        (f"`{name}`", *(maps[driver][name][shown] for _, driver, shown in columns))
        for name in maps[next(iter(drivers))]
    ]
    heads = ("map, the worst first", *(title for title, _, _ in columns))
    return table(heads, lines, is_right=True)


def names_table(
    head: str,
    names: Sequence[str],
    columns: Sequence[tuple[str, str, str, Figure]],
    results: Results,
) -> str:
    """Return a table with a row for each name; columns are (title, command, driver, figure)."""
    lines = [
        (f"`{name}`", *(
            write(results.of(filled_in(command, name), filled_in(driver, name)))
            for _, command, driver, write in columns
        ))
        for name in names
    ]  # fmt: skip
    return table((head, *(column[0] for column in columns)), lines, is_right=True)


DELAY = ("delay of an arrival", figure("delay_s", " s", interval="±"))
JERK = ("jerk", figure("mean_jerk_mps3", " m/s³", interval="±", interval_decimals=2))
TRIPS = ("trips", trips)
WAY = ("way per infraction", distance_per_infraction)


def shares(*names: str, decimals: int = 1, **titles: str) -> Rows:
    """Return a row for each share.

    The title of a row is the name of the share with spaces for `_`, unless `titles` has another.
    """
    return [
        (titles.get(name, name.replace("_", " ")), share(name, decimals=decimals)) for name in names
    ]


def task_card(task: str) -> ScoreTable:
    """Return the table for the card of a driver that was trained on one task."""
    driver = filled_in("NAME_ippo", task)
    command = f"cavmarl evaluate {task} -p {driver} -p idm -n 32 --seed 1000"
    alone = f"cavmarl evaluate {task} -p idm {ALONE} -n 16 --seed 1000"
    more = ("wrong_way", "blocked") if task == "intersection" else ()
    rows = [
        TRIPS,
        *shares("success", "arrived", "collision", "off_road", *more, "stood"),
        DELAY,
    ]
    columns = columns_of(command, ("idm alone", alone, "idm"))
    return ScoreTable(
        f"agents/{driver}/README.md",
        "scores",
        (command, alone),
        partial(drivers_table, columns, rows),
    )


CITIES_1000 = (
    "cavmarl evaluate cities_validation -p cities_residual -p cities_ippo -p idm "
    "-p shielded:cities_ippo -n 96 --seed 1000"
)
CITIES_CARD = (
    "cavmarl evaluate cities_validation -p cities_ippo -p idm -p shielded:cities_ippo -n 96 "
    "--seed 1000"
)
CITIES_ALONE = f"cavmarl evaluate cities_validation -p idm {ALONE} -n 96 --seed 500"
RESIDUAL = "cavmarl evaluate cities_validation -p cities_residual -p idm -n 96 --seed SEED"
SEEDS = ("5000", "6000")
SENSED = "cavmarl evaluate cities_validation -p cities_sensed -p idm -n 96 --seed 5000"
SENSED_TEST = "cavmarl evaluate NAME -p cities_sensed -p idm -n 96 --seed 1000"
SENSED_TESTS = ("cities_test", "cities_test_left")
CAREFUL = "cavmarl evaluate merge -p merge_careful_ippo -p cities_ippo -p idm -n 64 --seed 2000"
MERGE = (
    "cavmarl evaluate merge --policy merge_ippo --policy idm --policy random_actions "
    "--episodes 64 --repeats 5 --seed 1000"
)
MERGE_240 = (
    "cavmarl evaluate merge --policy merge_ippo --policy idm --set horizon_s=240 --episodes 32 "
    "--repeats 3 --seed 1000"
)
WORLDS = "cavmarl evaluate NAME -p idm -p random_actions --repeats 3 --episodes 8"
SCRIPTED = "cavmarl evaluate NAME -p idm -p random_actions --episodes 8 --seed 0"
TRAINED = "cavmarl evaluate NAME -p NAME_ippo -p idm -n 32 --seed 1000"
TRAINED_ALONE = f"cavmarl evaluate NAME -p idm {ALONE} -n 16 --seed 1000"
MESSAGES = (
    "cavmarl evaluate blind_junction -p gap_taker --episodes 64 --repeats 5 --seed 1000 "
    "--set v2x.channel.loss=LOSS"
)
RING22 = "python -m benchmarks ring22 -p ring22_ippo -p gentle -p idm --episodes 16 --seed 1000"

CITIES_ROWS = [
    TRIPS,
    *shares("success"),
    *shares("collision", "off_road", "red_light", decimals=2),
    *(
        (f"unfinished: {title}", row)
        for title, row in shares("blocked", "stood", "out_of_time", decimals=2)
    ),
    WAY,
    DELAY,
]
RESIDUAL_ROWS = [
    TRIPS,
    *shares("success"),
    ("of the worst map", worst_map),
    *shares("collision", "off_road", "red_light", decimals=2),
    WAY,
    DELAY,
]
WORLD_TEXTS = {
    "ring": "closed ring road, two lanes",
    "merge": "busy highway and an on-ramp whose lane ends",
    "grid4x4": "sixteen signalled crossings to cross in time",
    "town": "Berlin-Adlershof, 38 km of streets (extra `sumo`)",
    "rush": "the same map in four zones; all vehicles leave one quarter (extra `sumo`)",
}
LOSSES = {"none": "0", "10 %": "0.1", "20 %": "0.2", "30 %": "0.3", "40 %": "0.4", "50 %": "0.5"}
LOSSES["all"] = "1"


def worlds_table(results: Results) -> str:
    """Return the README's table of environments, with pictures."""
    short = [figure(name, decimals=0) for name in ("arrived", "collision")]
    lines = []
    for name, text in WORLD_TEXTS.items():
        card = f"envs/{name}/README.md"
        picture = f'<img src="docs/images/{name}.png" width="150" alt="">'
        cells = (
            " · ".join(write(results.of(filled_in(WORLDS, name), driver)) for write in short)
            for driver in ("idm", "random_actions")
        )
        lines.append((f"[{picture}]({card})", f"[`{name}`]({card}): {text}", *cells))
    return table(("", "world", "`idm`: arrived · collision, %", "`random_actions`"), lines)


def messages_table(results: Results) -> str:
    """Return the table of `gap_taker` at the blind junction with increasing loss of messages."""
    names = {"collision": "collision, %", "success": "success, %", "delay_s": "delay, s"}
    reports = {
        title: results.of(filled_in(MESSAGES, loss), "gap_taker") for title, loss in LOSSES.items()
    }
    lines = [
        (title, *(figure(name, interval="[]")(report) for name in names))
        for title, report in reports.items()
    ]
    paired = (difference(name, reports["none"], reports["all"]) for name in names)
    lines.append(("difference: no message lost - all lost", *paired))
    return table(("messages lost", *names.values()), lines, is_right=True)


def ring_rows(results: Results) -> dict[str, dict[str, Any]]:
    """Return the row of each driver in the benchmark `ring22`."""
    rows: dict[str, dict[str, Any]] = results.of(RING22, "idm")
    return rows


def ring_card(results: Results) -> str:
    """Return the table for the card of `ring22_ippo`."""
    lines = []
    for name, row in ring_rows(results).items():
        if name != "human":
            gain = f"{row['gain']:+.0f} %"
            ends = f"{row['least']:.2f}, {row['most']:.2f}"
            lines.append((name, f"{row['mean']:.2f}", ends, gain, str(row["crashed"])))
    lines.append(
        ("one more human driver", f"{ring_rows(results)['human']['mean']:.2f}", "", "", "")
    )
    heads = ("in the seat", "m/s", "least, most", "over human", "crashes")
    return table(heads, lines, is_right=True)


def ring_page(results: Results) -> str:
    """Return the table for the card of `ring22`."""
    texts = {
        "human": "one more human driver (`all_human.rou.xml`)",
        "idm": "`idm`",
        "gentle": "`gentle`, which speeds up by 0.03 m/s²",
        "ring22_ippo": "[`ring22_ippo`](../../agents/ring22_ippo/README.md), which has learnt to "
        "drive like `gentle`, but from its sensors alone (`gentle` also reads the world's clock)",
    }
    rows = ring_rows(results)
    lines = [
        (text, f"{rows[name]['mean']:.2f}", gain_text(rows[name])) for name, text in texts.items()
    ]
    return table(("seat of the agent", "m/s", "over human"), lines, is_right=True)


def gain_text(row: Mapping[str, Any]) -> str:
    """Return the gain in speed over human drivers as text."""
    return NONE if row.get("gain") is None else f"{row['gain']:+.0f} %"


def _cards() -> Iterator[ScoreTable]:
    """Return the tables in the cards of trained drivers."""
    yield from map(task_card, TASKS)
    page = "agents/cities_ippo/README.md"
    alone = ("idm alone", CITIES_ALONE, "idm")
    rows = [*CITIES_ROWS, JERK]
    shown = (CITIES_CARD, CITIES_ALONE)
    yield ScoreTable(
        page, "scores", shown, partial(drivers_table, columns_of(CITIES_CARD, alone), rows)
    )
    ours = [(name.replace("_", " "), "cities_ippo", name) for name in ("success", "collision")]
    idms = [(f"idm's {name}", "idm", name) for name in ("success", "collision")]
    yield ScoreTable(
        page, "scores by map", (CITIES_CARD,), partial(maps_table, CITIES_CARD, [*ours, *idms])
    )
    page, command = "agents/cities_residual/README.md", filled_in(RESIDUAL, SEEDS[0])
    speeding = ("mean speed above the limit", figure("mean_speeding", " %"))
    rows = [*CITIES_ROWS, speeding, JERK]
    yield ScoreTable(page, "scores", (command,), partial(drivers_table, columns_of(command), rows))
    ours = [
        (name.replace("_", " "), "cities_residual", name)
        for name in ("success", "collision", "red_light")
    ]
    yield ScoreTable(
        page, "scores by map", (command,), partial(maps_table, command, [*ours, *idms])
    )
    page = "agents/cities_sensed/README.md"
    rows = [*CITIES_ROWS, JERK]
    yield ScoreTable(page, "scores", (SENSED,), partial(drivers_table, columns_of(SENSED), rows))
    ours = [(name.replace("_", " "), "cities_sensed", name) for name in ("success", "collision")]
    yield ScoreTable(page, "scores by map", (SENSED,), partial(maps_table, SENSED, [*ours, *idms]))
    for name in SENSED_TESTS:
        command = filled_in(SENSED_TEST, name)
        yield ScoreTable(
            page, name, (command,), partial(drivers_table, columns_of(command), RESIDUAL_ROWS)
        )
    rows = [TRIPS, *shares("success", "collision", "off_road", "unfinished"), DELAY, JERK]
    yield ScoreTable(
        "agents/merge_careful_ippo/README.md",
        "scores",
        (CAREFUL,),
        partial(drivers_table, columns_of(CAREFUL), rows),
    )
    rows = [
        TRIPS,
        *shares("arrived", "collision", "off_road", "unfinished"),
        ("episode return", figure("episode_return", interval="±")),
        ("jerk, m/s³", figure("mean_jerk_mps3", interval="±")),
        ("delay of an arrival, s", figure("delay_s", interval="±")),
    ]
    yield ScoreTable(
        "agents/merge_ippo/README.md",
        "scores",
        (MERGE,),
        partial(drivers_table, columns_of(MERGE), rows),
    )
    yield ScoreTable("agents/ring22_ippo/README.md", "scores", (RING22,), ring_card)


def _pages() -> Iterator[ScoreTable]:
    """Return the tables of other pages."""
    yield ScoreTable("README.md", "environments", (WORLDS,), worlds_table, tuple(WORLD_TEXTS))
    yield ScoreTable("envs/ring22/README.md", "mean speed", (RING22,), ring_page)
    tasks, learning = "docs/figures/tasks.md", "docs/figures/learning.md"
    columns: list[tuple[str, str, str, Figure]] = [
        ("trips of `idm`", SCRIPTED, "idm", trips),
        *(
            (name, SCRIPTED, "idm", figure(name))
            for name in ("success", "arrived", "collision", "unfinished")
        ),
        ("delay, s", SCRIPTED, "idm", figure("delay_s")),
        ("`random_actions`: collision", SCRIPTED, "random_actions", figure("collision")),
    ]
    write = partial(names_table, "task", SCRIPTED_TASKS, columns)
    yield ScoreTable(tasks, "tasks", (SCRIPTED,), write, SCRIPTED_TASKS)
    columns = [
        ("trips", TRAINED, "NAME_ippo", trips),
        ("success", TRAINED, "NAME_ippo", figure("success", interval="[]")),
        ("collision", TRAINED, "NAME_ippo", figure("collision", interval="[]")),
        ("delay, s", TRAINED, "NAME_ippo", figure("delay_s")),
        ("`idm`: success", TRAINED, "idm", figure("success")),
        ("its collision", TRAINED, "idm", figure("collision")),
        ("its delay, s", TRAINED, "idm", figure("delay_s")),
        ("ceiling", TRAINED_ALONE, "idm", figure("success")),
    ]
    write = partial(names_table, "task", TASKS, columns)
    yield ScoreTable(tasks, "trained drivers", (TRAINED, TRAINED_ALONE), write, TASKS)
    yield ScoreTable(
        "docs/figures/messages.md", "messages", (MESSAGES,), messages_table, tuple(LOSSES.values())
    )
    rows: Rows = [
        *shares("arrived", "collision", "off_road", "unfinished", "red_light", "wrong_way"),
        (
            "TTC below 1.5 s, of the time",
            figure("short_ttc_share", " %", interval="[]"),
        ),
        JERK,
        DELAY,
    ]
    heads = [(f"`{name}`", MERGE_240, name) for name in drivers_of(MERGE_240)]
    yield ScoreTable(learning, "merge in 240 s", (MERGE_240,), partial(drivers_table, heads, rows))
    heads = [(f"`{name}`", CITIES_1000, name) for name in drivers_of(CITIES_1000)]
    write = partial(drivers_table, heads, RESIDUAL_ROWS)
    yield ScoreTable(learning, "cities of seed 1000", (CITIES_1000,), write)
    heads = [
        (title, filled_in(RESIDUAL, seed), driver)
        for seed in SEEDS
        for title, driver in ((f"seed {seed}", "cities_residual"), (f"`idm`, seed {seed}", "idm"))
    ]
    write = partial(drivers_table, heads, RESIDUAL_ROWS)
    yield ScoreTable(learning, "cities of other seeds", (RESIDUAL,), write, SEEDS)


TABLES: tuple[ScoreTable, ...] = (*_cards(), *_pages())
