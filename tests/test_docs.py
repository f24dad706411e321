"""The documentation agrees with the code."""

from __future__ import annotations

import inspect
import re
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from cavmarl.config.env import EnvConfig
from cavmarl.config.io import dotted_keys
from cavmarl.config.rig import CollisionConfig, SampledConfig
from cavmarl.config.terms import TERMS
from cavmarl.core.errors import missing
from cavmarl.engine import step_trace
from cavmarl.sensors.registry import TYPES
from tests.support.command_lines import check_command
from tests.support.generated import check_block, table

ROOT = Path(__file__).resolve().parents[1]
MAX_LINE = 120
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("envs/*/README.md")])
UNITS = {
    "m": "m", "s": "s", "mps": "m/s", "mps2": "m/s²", "rad": "rad", "ticks": "ticks", "hz": "Hz",
    "deg": "°",
}  # fmt: skip


def test_the_page_of_environments_lists_every_key() -> None:
    rows = key_rows(EnvConfig)
    assert [row[0].strip("`") for row in rows] == dotted_keys(EnvConfig)
    assert all(row[-1] for row in rows), "describe the key under Attributes:"
    header = ("key", "type", "unit", "default", "meaning")
    check_block(ROOT / "docs/reference/environments.md", "keys", table(header, rows))


def test_the_page_of_sensors_lists_every_type_and_key() -> None:
    page = ROOT / "docs/reference/sensors.md"
    types = [
        (
            f"`{kind.type}`",
            str(kind(**({} if kind is CollisionConfig else {"rate_hz": 10.0})).shape),
            f"`{np.dtype(TYPES[kind].dtype)}`",
            ", ".join(kind.units),
            " ".join(inspect.getdoc(kind).split("\n\n")[0].split()),
        )
        for kind in TYPES
    ]
    check_block(page, "types", table(("type", "sample", "dtype", "channels", "what"), types))
    common = key_rows(SampledConfig)
    known = {row[0] for row in common}
    own = [
        (f"`{kind.type}`", *row)
        for kind in TYPES
        for row in key_rows(kind)
        if row[0] not in known and row[0] != "`type`"
    ]
    header = ("key", "type", "unit", "default", "meaning")
    check_block(page, "common keys", table(header, common))
    check_block(page, "keys", table(("of", *header), own))


def test_the_drawing_of_the_cosimulation_cycle_equals_the_code() -> None:
    source = inspect.getsource(step_trace)
    meanings = dict(re.findall(r'^[A-Z]+ = "(\w+)"  # (.+)$', source, re.MULTILINE))
    nodes = [f'    {phase}["{phase}: {meanings[phase]}"]' for phase in step_trace.PHASES]
    lines = ["```mermaid", "flowchart TB", *nodes, f"    {' --> '.join(step_trace.PHASES)}"]
    lines += [f"    {step_trace.PHASES[-1]} -. next cycle .-> {step_trace.PHASES[0]}", "```"]
    check_block(ROOT / "docs/guides/cosimulation.md", "cycle", "\n".join(lines))


def test_the_drawing_of_the_five_layers_equals_its_table() -> None:
    page = ROOT / "docs/explanation/papers.md"
    text = page.read_text(encoding="utf-8").split("## Five layers")[1].split("\n## ")[0]
    rows = re.findall(r"^\| ([^|`]+) \| ([^|]*`[^|]*) \|", text, re.MULTILINE)
    nodes = []
    for k, (layer, content) in enumerate(rows):
        places = re.findall(r"`([\w/.]+)`", content)
        assert all((ROOT / "cavmarl" / place).exists() for place in places), layer
        nodes.append(f'    L{k}["{layer}<br/>{", ".join(places)}"]')
    assert len(nodes) == 5
    order = " --> ".join(f"L{k}" for k in range(len(nodes)))
    lines = ["```mermaid", "flowchart TB", *nodes, f"    {order}", "```"]
    check_block(page, "layers", "\n".join(lines))


def test_the_page_of_environments_explains_every_term() -> None:
    text = (ROOT / "docs/reference/environments.md").read_text(encoding="utf-8")
    assert tuple(re.findall(r"^\| `(\w+)` \|", text.split("## Terms")[1], re.MULTILINE)) == TERMS


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_pages_lead_to_existing_files(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_the_readme_has_at_most_100_lines_and_its_example_runs() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 100
    example = re.search(r"^```python\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    assert example
    names: dict[str, Any] = {}
    exec(example[1], names)
    assert not names["env"].agents


def test_pages_and_errors_name_an_installation_from_a_checkout() -> None:
    by_name = re.compile(r"pip install[^`\n]*\bcavmarl\[")
    texts = [*PAGES, *ROOT.glob("cavmarl/**/*.py"), *ROOT.glob("train/*.py")]
    assert [path.name for path in texts if by_name.search(path.read_text(encoding="utf-8"))] == []
    assert f"pip install -e '{ROOT}[train]'" in str(missing("torch", "train")).replace(
        "'.", f"'{ROOT}"
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_anchors_of_links_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#]*)#([^)]+)\)", text):
        other = page.parent / target if target else page
        assert anchor in anchors_of(other), f"{target}#{anchor}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_lines_of_pages_are_short(page: Path) -> None:
    """Rows of tables and code are exempt, because they cannot be wrapped."""
    code = False
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), start=1):
        code ^= line.lstrip().startswith("```")
        if not code and not line.lstrip().startswith("|"):
            assert len(line) <= MAX_LINE, f"{page.name}:{number}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_use_no_words_for_persons(page: Path) -> None:
    """Generated blocks are not checked."""
    text = re.sub(r"<!-- [\w ]+ -->.*?<!-- end -->", "", page.read_text("utf-8"), flags=re.DOTALL)
    words = r"\b(?:nobody|somebody|anybody|everybody|whoever)\b.*"
    assert not re.findall(words, text, re.IGNORECASE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_python_files_that_a_page_names_exist(page: Path) -> None:
    """A path is relative to the root, to `cavmarl/` or to the page; a file name has no path."""
    for named in re.findall(r"`([\w./-]+\.py)`", page.read_text(encoding="utf-8")):
        if page.name == "CHANGELOG.md" or "NAME" in named or named.startswith("my_"):
            continue
        if "/" in named:
            places = (ROOT, ROOT / "cavmarl", page.parent)
            assert any((place / named).is_file() for place in places), named
        else:
            assert named in names_of_code(), named


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_benchmarks_that_a_page_names_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"python -m benchmarks[. ]([a-z]\w*)", text):
        assert (ROOT / f"benchmarks/{name}.py").is_file(), name
    for name in re.findall(r"`cavmarl bench (\w+)", text):
        assert (ROOT / f"cavmarl/cli/bench/{name}.py").is_file(), name


@cache
def names_of_code() -> frozenset[str]:
    """Return the names of all Python files of the repository."""
    folders = ("agents", "benchmarks", "cavmarl", "docs", "fuzz", "tests", "train")
    return frozenset(path.name for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def anchors_of(page: Path) -> frozenset[str]:
    """Return the anchors of a page's headings, as GitHub makes them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.M | re.S)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    words = (re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings)
    return frozenset(word.replace(" ", "-") for word in words)


def key_rows(kind: type[Any], prefix: str = "") -> list[tuple[str, str, str, str, str]]:
    """Return (key, type, unit, default, meaning) for each key of a configuration class."""
    hints, rows = get_type_hints(kind), []
    meanings = {"type": ""}
    for base in reversed(kind.__mro__[:-1]):
        meanings |= attribute_texts(base)
    for field in fields(kind):
        key, hint = f"{prefix}{field.name}", hints[field.name]
        if isinstance(hint, type) and is_dataclass(hint):
            rows += key_rows(hint, f"{key}.")
            continue
        default = field.default if field.default_factory is MISSING else field.default_factory()
        unit = UNITS.get(key.rpartition("_")[2], "")
        rows.append(
            (f"`{key}`", type_text(hint), unit, default_text(default), meanings[field.name])
        )
    return rows


def attribute_texts(kind: type[Any]) -> dict[str, str]:
    """Return the description of each field under `Attributes:` in a docstring, on one line."""
    _, _, section = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    items = re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", section, re.MULTILINE)
    return {name: " ".join(text.split()).replace("|", "\\|") for name, text in items}


def type_text(hint: Any) -> str:
    if get_origin(hint) is Literal:
        return " or ".join(f"`{choice}`" for choice in get_args(hint))
    if is_dataclass(hint):
        return "keys"
    if get_origin(hint) is None:
        return {int: "whole number", float: "number", bool: "bool", str: "text"}[hint]
    inner = [type_text(part) for part in get_args(hint) if part not in (..., type(None))]
    if get_origin(hint) is UnionType:
        return " or ".join(dict.fromkeys(inner))
    return {tuple: "list of ", dict: "mapping of "}.get(get_origin(hint), "") + " to ".join(inner)


def list_text(items: tuple[Any, ...]) -> str:
    """Return a list as YAML writes it on one line."""
    texts = (
        list_text(item)
        if isinstance(item, tuple)
        else item
        if isinstance(item, str)
        else f"{item:g}"
        for item in items
    )
    return f"[{', '.join(texts)}]"


def default_text(value: object) -> str:
    match value:
        case _ if value is MISSING:
            return "needed"
        case None | ():
            return ""
        case bool():
            return f"`{str(value).lower()}`"
        case tuple():
            return f"`{list_text(value)}`"
        case dict():
            return ", ".join(f"`{key}` {item:g}" for key, item in value.items())
        case float():
            return f"`{value:.6g}`"
    return f"`{value}`"


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name != "CHANGELOG.md" and page.parent.name != "decisions"],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
def test_commands_on_pages_are_valid(page: Path) -> None:
    """Commands on pages exist and have the given options."""
    for line in commands_of(page.read_text(encoding="utf-8")):
        check_command(line)


def commands_of(text: str) -> list[str]:
    """Return the calls of `cavmarl` in code, without redirections and optional parts."""
    blocks = re.findall(r"```(?:sh|bash|console)\n(.*?)```", text, re.DOTALL)
    lines = [line for block in blocks for line in re.sub(r"\\\n\s*", " ", block).splitlines()]
    lines += [re.sub(r"\s+", " ", inline) for inline in re.findall(r"`(cavmarl [^`]+)`", text)]
    calls = [re.split(r" (?:\||>|&&|;|&)(?: |$)", line.strip().lstrip("$ "))[0] for line in lines]
    return [re.sub(r" \[.*?\]", "", call) for call in calls if call.startswith("cavmarl ")]
