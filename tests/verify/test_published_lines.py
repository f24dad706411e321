"""Every published number has a line in lines.yaml; every line has a page and a command."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest
import typer

from cavmarl.cli.report_command import report_command
from cavmarl.core.errors import ConfigError
from cavmarl.verify.published_lines import (
    FREE_NUMBER,
    PublishedLine,
    PublishedLines,
    cells_of,
    compile_pattern,
    find_table,
    find_text,
    label_of,
    read_lines,
    repository_root,
    section_of,
    tables_of,
    with_row,
    without_code,
)
from tests.support.command_lines import check_command, check_options

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = read_lines(ROOT)
FIGURES = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.glob("docs/figures/*.md"))
PAGES = ["README.md", *(page for page in FIGURES if not page.endswith("README.md"))]


@pytest.mark.parametrize("name", PUBLISHED.lines)
def test_a_line_finds_its_numbers_on_its_page(name: str) -> None:
    line = PUBLISHED.lines[name]
    cells = cells_of(name, line, ROOT)
    assert any(cell.numbers for cell in cells)
    if not line.by_hand:
        assert any(any(cell.expressions) for cell in cells), "the line compares no number"


def test_the_command_of_a_line_is_on_its_page() -> None:
    texts = {page: " ".join((ROOT / page).read_text("utf-8").split()) for page in PAGES}
    lines = PUBLISHED.lines.items()
    assert [name for name, one in lines if shown(one.command) not in texts[one.page]] == []


def test_each_condition_is_on_its_page() -> None:
    for page, patterns in PUBLISHED.conditions.items():
        text = (ROOT / page).read_text("utf-8")
        assert [one for one in patterns if not compile_pattern(one).search(text)] == []


BENCHMARK = re.compile(r"python -m benchmarks[. ](\w+)(.*)")


@pytest.mark.parametrize(
    "command", sorted({one.command for one in PUBLISHED.lines.values() if one.command})
)
def test_each_command_exists_with_its_options(command: str) -> None:
    if found := BENCHMARK.search(command):
        app = typer.Typer()
        app.command()(report_command(import_module(f"benchmarks.{found[1]}").measure))
        check_options(typer.main.get_command(app), shlex.split(found[2].replace("…", "")))
    elif command.startswith("cavmarl "):
        check_command(command)
    else:
        words = [word for word in shlex.split(command) if "/" in word]
        assert command == "make soak" or all((ROOT / word).exists() for word in words)


def shown(command: str) -> str:
    """Return a command in the form in which the pages show it."""
    command = re.sub(r"--agents (25|50|100) --background 0", "--agents N --background 0", command)
    return re.sub(r"--seed [56]000$", "--seed SEED", command)


@pytest.mark.parametrize("page", PAGES)
def test_every_number_of_a_page_belongs_to_a_line_or_condition(page: str) -> None:
    assert list(uncovered(page, (ROOT / page).read_text("utf-8"), PUBLISHED)) == []


def uncovered(page: str, text: str, published: PublishedLines) -> Iterator[str]:
    """Yield numbers of a page that belong to no line and no condition, with their context."""
    headings = re.compile("^#.*", re.MULTILINE)  # headings may contain any numbers
    seen = headings.sub(lambda found: " " * len(found[0]), without_code(text))
    spans = [span for span, _ in covered(page, text, published)]
    for number in re.finditer(FREE_NUMBER, seen):
        start, end = number.span()
        if not any(low <= start and end <= high for low, high in spans):
            yield " ".join(text[max(start - 40, 0) : end + 30].split())


def covered(
    page: str, text: str, published: PublishedLines
) -> Iterator[tuple[tuple[int, int], str]]:
    """Yield the spans of a page that belong to lines and conditions, with their names."""
    for pattern in published.conditions.get(page, ()):
        for match in compile_pattern(pattern).finditer(text):
            yield match.span(), pattern
    for name, line in published.lines.items():
        if line.page != page:
            continue
        yield from ((span, name) for span in text_spans(name, line, text))
        if line.is_section:
            below = section_of(name, line.section, text)
            start = text.index(below)
            yield (start, start + len(below)), name
        if line.table:
            yield from ((span, name) for span in table_spans(name, line, text))


def text_spans(name: str, line: PublishedLine, text: str) -> Iterator[tuple[int, int]]:
    """Yield the spans of the compared numbers of a line, or of its patterns if it has by_hand."""
    size = 2 if line.tolerance.startswith("range") else 1
    expressions = [each for each in line.values for _ in range(size)]
    for pattern in line.text:
        match = find_text(name, pattern, text)
        if line.by_hand:
            yield match.span()
        for number, expression in enumerate(expressions[: len(match.groups())], start=1):
            if expression:
                yield match.span(number)
        del expressions[: len(match.groups())]


def table_spans(name: str, line: PublishedLine, text: str) -> Iterator[tuple[int, int]]:
    """Yield the spans of the table cells of a line, of its row labels and of the column heads."""
    table = find_table(name, line, text)
    wanted = {place for place, head in enumerate(table.heads) if head in line.columns}
    section = 0 if not table.section else text.index(f"# {table.section}\n")
    for row in (table.heads, *table.rows):
        pattern = r"\|\s*" + r"\s*\|\s*".join(map(re.escape, row)) + r"\s*\|"
        is_head = row is table.heads
        for match in re.finditer(pattern, text[section:]):
            if is_head or not line.rows or label_of(row) in line.rows:
                start = section + match.start()
                label = next((at for at, cell in enumerate(row) if label_of((cell,))), 0)
                for place, cell in enumerate(match[0].split("|")[1:-1]):
                    if is_head or place == label or place in wanted:
                        yield start, start + len(cell) + 1
                    start += len(cell) + 1


def test_a_number_without_a_line_is_found() -> None:
    page = (
        "# A\n\nIt takes 3 s on 2 cores.\n\n| a | b |\n|---|---|\n| x | 4 |\n| y 7 | 5 |\n\n`8`\n"
    )
    line = PublishedLine("page.md", "cavmarl list", table="a", rows={"x": "x"}, columns={"b": "at"})
    published = PublishedLines({"line": line}, {"page.md": ("on {} cores",)})
    found = " ".join(uncovered("page.md", page, published))
    assert "takes 3 s" in found
    assert "| y 7" in found
    line = PublishedLine("page.md", "cavmarl list", table="a", columns={"b": "at"})
    seconds = PublishedLine("page.md", "cavmarl list", text=("takes {} s",), values=("s",))
    published = PublishedLines({"line": line, "s": seconds}, {"page.md": ("on {} cores",)})
    assert list(uncovered("page.md", page, published)) == []


@pytest.mark.parametrize(
    ("text", "values", "by_hand", "left"),
    [
        ("takes {} s on {} cores", ("s", "cores"), "", []),
        ("takes {} s on 2 cores", ("s",), "", ["2"]),
        ("takes {} s on {} cores", ("s", ""), "", ["2"]),
        ("takes {} s on 2 cores", (), "It takes a week.", []),
    ],
)
def test_only_compared_numbers_are_covered(
    text: str, values: tuple[str, ...], by_hand: str, left: list[str]
) -> None:
    page = "It takes 3 s on 2 cores."
    line = PublishedLine("page.md", "cavmarl list", text=(text,), values=values, by_hand=by_hand)
    found = list(uncovered("page.md", page, PublishedLines({"line": line})))
    assert len(found) == len(left)
    assert all(number in one for number, one in zip(left, found, strict=True))


def test_quick_lines_have_exact_tolerances_and_no_requirements() -> None:
    for name, line in PUBLISHED.lines.items():
        if line.is_quick:
            assert (line.needs, line.tolerance, line.by_hand) == ((), "exact", ""), name


PAGE = """# Page

It is 1,234.5 times
as fast, and 7 to 9 m.

| name | a | b |
|---|---|---|
| [`one`](x.md) | 3 ± 0.5 | - |
| **two-2** | 4 [1, 8] | 5 |

| twice | b | b | c |
|---|---|---|---|
| one | 1 | 2 | 3 |
| one | 4 | 5 | 6 |
"""


def cells(tmp_path: Path, quick: bool = False, **keys: object) -> list[tuple[str, ...]]:
    (tmp_path / "page.md").write_text(PAGE, encoding="utf-8")
    line = PublishedLine("page.md", "cavmarl NAME NAME_ippo", **keys)  # type: ignore[arg-type]
    found = cells_of("line", line, tmp_path, quick=quick)
    return [
        (cell.command, *cell.numbers, "/", *cell.expressions, *filter(None, [cell.row]))
        for cell in found
    ]


def test_numbers_in_prose_are_found_across_line_breaks(tmp_path: Path) -> None:
    found = cells(tmp_path, text=("is {} times as fast, and {} to {} m",), values=("a", "", "b"))
    assert found == [("cavmarl NAME NAME_ippo", "1,234.5", "7", "9", "/", "a", "", "b")]


def test_a_range_of_two_numbers_has_one_expression(tmp_path: Path) -> None:
    found = cells(tmp_path, text=("and {} to {} m",), values=("b",), tolerance="range")
    assert found == [("cavmarl NAME NAME_ippo", "7", "9", "/", "b")]


def test_cells_of_tables_are_found_by_row_and_column(tmp_path: Path) -> None:
    keys: dict[str, object] = {
        "table": "name",
        "word": "NAME",
        "columns": {"a": "at.NAME", "b": "x"},
    }
    expected = [
        ("cavmarl one one_ippo", "3", "0.5", "/", "at.one"),
        ("cavmarl two-2 two_2_ippo", "4", "1", "8", "/", "at.two-2"),
        ("cavmarl two-2 two_2_ippo", "5", "/", "x"),
    ]
    assert cells(tmp_path, **keys) == expected
    assert cells(tmp_path, quick=True, quick_rows=("one",), **keys) == expected[:1]
    own = cells(tmp_path, **{**keys, "rows": {"one": "1"}, "row": "rows[n=NAME]"})
    assert own == [("cavmarl 1 1_ippo", "3", "0.5", "/", "at.1", "rows[n=1]")]


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"text": ("is {} slow",)}, r"has no text .*write the pattern so that it occurs once"),
        ({"text": ("{}",)}, r"has \d+ texts '\{\}'"),
        ({"text": ("is {} times",), "values": ("a", "b")}, "1 expressions without a number"),
        ({"text": ("and {} to {} m",), "values": ("a",)}, "too few expressions"),
        ({"table": "nam | c"}, "has 0 tables that begin with"),
        ({"table": "name", "section": "Other"}, "below 'Other'; correct table, section or nth"),
        ({"table": "name", "columns": {"c": "x"}}, "no column 'c'; it has name | a | b"),
        ({"table": "name", "rows": {"three": ""}}, "no row 'three'; it has one, two-2"),
        ({"table": "name", "quick_rows": ("three",)}, "no row 'three'"),
        ({"section": "Other", "by_hand": "slow"}, "no heading 'Other'"),
        ({}, "either text or table"),
        ({"table": "name", "tolerance": "range"}, "is for text; tables have N % or N"),
        ({"text": ("is {} times",), "tolerance": "range"}, "two numbers for each range"),
        ({"text": ("a",), "table": "a"}, "either text or table"),
        ({"text": ("a",), "tolerance": "about"}, "must be exact, range, range N %, N % or N"),
        ({"text": ("a",), "tolerance": "100 %"}, "with N % below 100 %"),
        ({"text": ("a",), "tolerance": "range 150 %"}, "with N % below 100 %"),
        ({"text": ("a",), "tolerance": "1.2.3"}, "must be exact"),
        ({"table": "name", "columns": {"a": ""}}, "'a' has no expression; leave out columns"),
        ({"table": "twice", "columns": {"b": "x"}}, "the table has 'b' twice; rename one"),
        ({"table": "twice", "columns": {"c": "x"}}, "the table has 'one' twice; rename one"),
        ({"text": ("a",), "needs": ("luck",)}, "'luck' must be KIND:NAME"),
    ],
)
def test_wrong_lines_are_refused(keys: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=message):
        cells(tmp_path, **keys)


def test_published_lines_outside_of_a_checkout_are_an_error(tmp_path: Path) -> None:
    assert repository_root() == ROOT
    with pytest.raises(ConfigError, match=r"has no docs/figures/lines\.yaml.*from one with"):
        repository_root(tmp_path)


def test_a_line_with_a_missing_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"line: there is no page gone\.md"):
        cells_of("line", PublishedLine("gone.md", "cavmarl list", text=("a",)), tmp_path)


def test_unknown_keys_of_lines_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "docs/figures/lines.yaml"
    path.parent.mkdir(parents=True)
    path.write_text("lines: {one: {page: a.md, command: cavmarl list, text: [a], speedy: true}}\n")
    with pytest.raises(ConfigError, match=r"lines\.one\.speedy: unknown key"):
        read_lines(tmp_path)


def test_only_whole_words_are_replaced() -> None:
    assert with_row("N --n N NAME N_ippo", "N", "u-turn") == "u-turn --n u-turn NAME u_turn_ippo"


def test_tables_in_code_blocks_are_ignored() -> None:
    text = "# A\n```\n| a |\n|---|\n| 1 |\n```\n## B\n| b | c |\n|---|---|\n| 1 | x \\| y |\n"
    (table,) = tables_of(text)
    assert (table.section, table.heads, table.rows) == ("B", ("b", "c"), (("1", "x \\| y"),))
