"""Published numbers. A line lists numbers of a page, the command to repeat them, and a tolerance.

`docs/figures/lines.yaml` has the lines. The published values are read from the pages themselves:
from prose by patterns in which `{}` stands for a number, from tables by row and column.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import NamedTuple

from cavmarl.config.io import read_yaml, validate
from cavmarl.core.errors import ConfigError

LINES_FILE = Path("docs/figures/lines.yaml")
NUMBER = r"[-+]?(?:[0-9]{1,3}(?:,[0-9]{3})+|[0-9]+)(?:\.[0-9]+)?"
FREE_NUMBER = re.compile(rf"(?<![\w.,]){NUMBER}")  # excludes the end of names and versions
_TOLERANCE = re.compile(
    r"exact|range(?: {0}{1} %)?|{0}{1} %|[0-9]+{1}".format("[0-9]{1,2}", r"(?:\.[0-9]+)?")
)  # N % is below 100 %: a tolerance of 100 % accepts any published number that is too large
_NEEDS = ("module", "program", "variable", "file")


@dataclass(frozen=True)
class PublishedLine:
    """Numbers of a page and the command that repeats them.

    Attributes:
        page: path of the page in the repository.
        command: the command, as the page shows it.
        text: patterns of prose or of whole rows, in which `{}` stands for a number. Each occurs
            once in the page.
        values: for each `{}`, an expression that finds the value in the command's JSON. If an
            expression is empty, the number is not compared. Leave it empty for a setting that the
            page states, and in lines with by_hand. With the tolerance `range`, two numbers have one
            expression.
        table: beginning of the header row of a table.
        section: heading above the table; empty if the header row is unique in the page. Without
            text and table, the line has all numbers of this section that no other line has.
        nth: number of the table among the tables with this header in this section, from 1.
        row: path of the object to which the expressions of columns are relative.
        word: placeholder in the command, the expressions and `row`, for example `NAME`. For each
            row of the table, the row's value in `rows` replaces it. In `NAME_…`, the value has `_`
            in place of `-`; the final `_` stays.
        rows: label of a row → value that replaces the word; empty: all rows, with their labels.
        columns: text of the header → expression.
        tolerance: `exact` (equal in the digits of the page); `N %` of the published number; `N`
            (largest difference); `range` (measured values lie between the two published numbers);
            `range N %` (the range is wider by N % on both sides).
        needs: requirements: `module:NAME`, `program:NAME`, `variable:NAME` of the environment, or
            `file:WORD`, where WORD is a word of the command that `--file` replaces.
        minutes: how long the command takes.
        quick: whether `--quick` repeats the line. Its command must end within seconds, and its
            result must have the same bytes on every machine.
        quick_rows: labels of the rows that `--quick` repeats.
        by_hand: why no command can repeat these numbers; the line is then shown and not run.
    """

    page: str
    command: str
    text: tuple[str, ...] = ()
    values: tuple[str, ...] = ()
    table: str = ""
    section: str = ""
    nth: int = 1
    row: str = ""
    word: str = "ROW"
    rows: Mapping[str, str] = field(default_factory=dict)
    columns: Mapping[str, str] = field(default_factory=dict)
    tolerance: str = "exact"
    needs: tuple[str, ...] = ()
    minutes: float = 1.0
    quick: bool = False
    quick_rows: tuple[str, ...] = ()
    by_hand: str = ""

    def __post_init__(self) -> None:
        if bool(self.text) + bool(self.table) != 1 and not (self.is_section and self.by_hand):
            raise ConfigError(
                "a line has either text or table; only a line with by_hand may have a section alone"
            )
        if not _TOLERANCE.fullmatch(self.tolerance):
            raise ConfigError(
                f"tolerance = {self.tolerance!r}: must be exact, range, range N %, N % or N, with "
                "N % below 100 %"
            )
        if self.table and self.tolerance.startswith("range"):
            raise ConfigError("tolerance = range: is for text; tables have N % or N")
        for need in self.needs:
            kind, _, name = need.partition(":")
            if kind not in _NEEDS or not name:
                raise ConfigError(f"needs: {need!r} must be KIND:NAME; KIND is {', '.join(_NEEDS)}")
        if unused := [head for head, expression in self.columns.items() if not expression]:
            raise ConfigError(
                f"columns: {unused[0]!r} has no expression; leave out columns that are not compared"
            )
        if not self.by_hand and not self.command:
            raise ConfigError("command: missing; give the command that repeats the numbers")

    @property
    def is_section(self) -> bool:
        """Whether the line has the numbers of a whole section."""
        return bool(self.section) and not (self.text or self.table)

    @property
    def is_quick(self) -> bool:
        """Whether `--quick` repeats the line or a part of it."""
        return self.quick or bool(self.quick_rows)


@dataclass(frozen=True)
class PublishedLines:
    """All lines, and the numbers on pages that are not results.

    Attributes:
        lines: lines by name.
        conditions: page → patterns of numbers that are conditions, settings or versions.
    """

    lines: dict[str, PublishedLine]
    conditions: dict[str, tuple[str, ...]] = field(default_factory=dict)


class PublishedCell(NamedTuple):
    """Published numbers that belong to one command.

    Attributes:
        place: row and column, or the pattern; for messages.
        command: the command with the row's label.
        numbers: texts of the numbers.
        expressions: an expression for each number or, in a table, one for all of them.
        row: path of the object to which the expressions are relative; empty: the whole JSON.
    """

    place: str
    command: str
    numbers: tuple[str, ...]
    expressions: tuple[str, ...]
    row: str = ""


@dataclass(frozen=True)
class PageTable:
    """A table of a page.

    Attributes:
        section: the heading above the table.
        heads: texts of the header row.
        rows: texts of the cells.
    """

    section: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def repository_root(start: Path | None = None) -> Path:
    """Return the folder of the checkout that contains the package, or `start`.

    Raises:
        ConfigError: this is not a checkout, since the pages with the numbers are missing.
    """
    root = start or Path(__file__).resolve().parents[2]
    if not (root / LINES_FILE).is_file():
        raise ConfigError(
            f"{root}: has no {LINES_FILE}; the published numbers are in a checkout of the "
            "repository: install cavmarl from one with `pip install -e .`"
        )
    return root


def read_lines(root: Path) -> PublishedLines:
    """Read the lines of a checkout.

    Raises:
        ConfigError: the file is unreadable, or a line has an unknown key or a wrong value.
    """
    path = root / LINES_FILE
    return validate(PublishedLines, read_yaml(path), str(path))


def cells_of(
    name: str, line: PublishedLine, root: Path, *, quick: bool = False
) -> list[PublishedCell]:
    """Return the published numbers of a line, as the page shows them.

    Args:
        name: name of the line.
        line: the line.
        root: root folder of the checkout.
        quick: whether to return only the rows that `--quick` repeats.

    Raises:
        ConfigError: the page has no such text, table, row or column, or has a text twice.
    """
    page = root / line.page
    if not page.is_file():
        raise ConfigError(f"{LINES_FILE}: {name}: there is no page {line.page}")
    text = page.read_text(encoding="utf-8")
    where = f"{LINES_FILE}: {name}: {line.page}"
    if line.is_section:
        numbers = re.findall(FREE_NUMBER, without_code(section_of(where, line.section, text)))
        return [PublishedCell(line.section, line.command, tuple(numbers), ())]
    if line.text:
        return list(_text_cells(where, line, text))
    return list(_table_cells(where, line, text, quick))


def find_text(where: str, pattern: str, text: str) -> re.Match[str]:
    """Return the only match of a pattern in a page; raises ConfigError: no match, or several."""
    found = list(compile_pattern(pattern).finditer(text))
    if len(found) != 1:
        count = "no text" if not found else f"{len(found)} texts"
        raise ConfigError(
            f"{where} has {count} {pattern!r}; write the pattern so that it occurs once"
        )
    return found[0]


def compile_pattern(pattern: str) -> re.Pattern[str]:
    """Compile a pattern: `{}` matches a number, and a space also matches a line break."""
    parts = [r"\s+".join(map(re.escape, part.split(" "))) for part in pattern.split("{}")]
    return re.compile(f"({NUMBER})".join(parts))


def section_of(where: str, section: str, text: str) -> str:
    """Return the text below a heading, up to the next heading; raises ConfigError: no heading."""
    found = re.search(rf"^#+ {re.escape(section)}\n(.*?)(?=^#|\Z)", text, re.DOTALL | re.MULTILINE)
    if found is None:
        raise ConfigError(f"{where} has no heading {section!r}; correct the section")
    return found[1]


def without_code(text: str) -> str:
    """Return a page's text with code, comments and targets of links replaced by blanks."""
    code = r"^```.*?^```|`[^`]*`|<[^>]*>|(?<=\])\([^)]*\)"
    blank = partial(re.sub, r"[^\n]", " ")
    return re.sub(code, lambda found: blank(found[0]), text, flags=re.DOTALL | re.MULTILINE)


def tables_of(text: str) -> Iterator[PageTable]:
    """Yield the tables of a page, in order."""
    section, lines, is_code = "", [], False
    for each in [*text.splitlines(), ""]:
        is_code ^= each.startswith("```")
        if each.startswith("|") and not is_code:
            lines.append(each)
            continue
        if len(lines) > 2:
            heads, _, *rows = (_cells(row) for row in lines)
            yield PageTable(section, heads, tuple(rows))
        lines = []
        if each.startswith("#") and not is_code:
            section = each.lstrip("# ")


def find_table(where: str, line: PublishedLine, text: str) -> PageTable:
    """Return the table of a line; raises ConfigError if the page does not have it."""
    wanted = " | ".join(part.strip() for part in line.table.split("|"))
    found = [
        table
        for table in tables_of(text)
        if " | ".join(table.heads).startswith(wanted) and line.section in ("", table.section)
    ]
    if not 1 <= line.nth <= len(found):
        raise ConfigError(
            f"{where} has {len(found)} tables that begin with {line.table!r}"
            f"{f' below {line.section!r}' if line.section else ''}; correct table, section or nth"
        )
    if not line.section and line.nth == 1 and len(found) > 1:
        raise ConfigError(f"{where} has several tables {line.table!r}; name the section")
    return found[line.nth - 1]


def label_of(row: tuple[str, ...]) -> str:
    """Return the text of the first non-empty cell, without links, pictures and markup."""
    for cell in row:
        text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", re.sub(r"<[^>]*>", "", cell))
        if text := text.replace("`", "").replace("*", "").strip():
            return text
    return ""


def _text_cells(where: str, line: PublishedLine, text: str) -> Iterator[PublishedCell]:
    left = list(line.values)
    for pattern in line.text:
        numbers = find_text(where, pattern, text).groups()
        count = len(numbers)
        if line.tolerance.startswith("range"):
            count, odd = divmod(count, 2)
            if odd:
                raise ConfigError(f"{where}: {pattern!r} needs two numbers for each range")
        own, left = left[:count], left[count:]
        if not line.by_hand and line.values and len(own) < count:
            raise ConfigError(f"{where}: values has too few expressions for {pattern!r}")
        yield PublishedCell(pattern, line.command, numbers, tuple(own))
    if left:
        raise ConfigError(f"{where}: values has {len(left)} expressions without a number")


def _table_cells(
    where: str, line: PublishedLine, text: str, quick: bool
) -> Iterator[PublishedCell]:
    table = find_table(where, line, text)
    labels = {label_of(row): row for row in table.rows}
    names = [label_of(row) for row in table.rows if not line.rows or label_of(row) in line.rows]
    if twice := _twice([head for head in table.heads if head in line.columns]) or _twice(names):
        raise ConfigError(f"{where}: the table has {twice!r} twice; rename one of the two")
    if unknown := [*(line.rows.keys() | set(line.quick_rows)) - labels.keys()]:
        raise ConfigError(
            f"{where}: the table has no row {unknown[0]!r}; it has {', '.join(labels)}"
        )
    if unknown := [head for head in line.columns if head not in table.heads]:
        raise ConfigError(
            f"{where}: the table has no column {unknown[0]!r}; it has {' | '.join(table.heads)}"
        )
    for label, cells in labels.items():
        is_wanted = not line.rows or label in line.rows
        if not is_wanted or (quick and line.quick_rows and label not in line.quick_rows):
            continue
        value = line.rows.get(label, label)
        for head, expression in line.columns.items():
            numbers = tuple(re.findall(FREE_NUMBER, cells[table.heads.index(head)]))
            if numbers:
                given = (line.command, expression, line.row)
                command, expression, row = (with_row(one, line.word, value) for one in given)
                yield PublishedCell(f"{label}, {head}", command, numbers, (expression,), row)


def _twice(texts: list[str]) -> str:
    """Return the first text that occurs again; empty: none."""
    return next((text for text in texts if texts.count(text) > 1), "")


def with_row(text: str, word: str, value: str) -> str:
    """Return a command or an expression in which the value of a row replaces the word."""
    text = re.sub(rf"(?<![A-Za-z]){word}_", f"{value.replace('-', '_')}_", text)
    return re.sub(rf"(?<![A-Za-z]){word}(?![A-Za-z])", value, text)


def _cells(row: str) -> tuple[str, ...]:
    parts = re.split(r"(?<!\\)\|", row.strip().strip("|"))
    return tuple(part.strip() for part in parts)
