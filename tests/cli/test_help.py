"""The help of each command: groups, value names, and examples that work."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.support.command_lines import check_command, whole_command


def commands(group: Any = None, words: str = "cavmarl") -> Iterator[tuple[str, Any]]:
    """Yield the words that call each command, and the command."""
    group = group or whole_command()
    context = group.make_context(words, [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if hasattr(command, "list_commands"):
            yield from commands(command, f"{words} {name}")
        else:
            yield f"{words} {name}", command


COMMANDS = dict(commands())


@pytest.mark.parametrize("words", COMMANDS)
def test_help_ends_with_valid_examples(words: str) -> None:
    title, *examples = COMMANDS[words].epilog.split("\n\n")
    assert title == "Examples:"
    assert examples
    for line in examples:
        assert words in line
        check_command(line[line.index("cavmarl") :])


def test_the_help_of_submit_has_no_import_option_and_says_what_is_uploaded() -> None:
    """A service does not import modules of its callers."""
    command = COMMANDS["cavmarl submit"]
    options = {word for one in command.params for word in one.opts}
    assert "--import" not in options
    texts = [one.help for one in command.params if one.name in ("env", "policy")]
    assert len(texts) == 2
    assert all("uploaded once" in text for text in texts)


@pytest.mark.parametrize("words", COMMANDS)
def test_help_describes_the_value_of_each_option(words: str) -> None:
    command = COMMANDS[words]
    context = command.make_context(words, [], resilient_parsing=True)
    for parameter in command.params:
        text = parameter.help or ""
        assert text.endswith("."), f"{parameter.name}: {text}"
        assert text[:1].isupper() or text[:1].isdigit(), f"{parameter.name}: {text}"
        assert "[default" not in text, f"{parameter.name}: '[default' is hidden as markup"
        if parameter.param_type_name == "option":
            value = parameter.display_type_rich(context)
            assert not value or "|" in value or not value.startswith("<"), (
                f"{parameter.name}: the value has no name"
            )


@pytest.mark.parametrize("words", COMMANDS)
def test_help_shows_no_value_for_flags_and_no_double_brackets(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        COMMANDS[words](["--help"])
    shown = capsys.readouterr().out
    assert "--help" in shown
    assert "<bool>" not in shown
    assert "[[" not in shown


def test_the_commands_are_grouped_by_task(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        whole_command()(["--help"])
    shown = capsys.readouterr().out
    panels = ("Start here", "Train and evaluate", "Maps and demand", "Divide worlds", "Service")
    places = [shown.index(panel) for panel in panels]
    assert places[0] == min(places)
    assert shown.index(" demo ") < shown.index(" evaluate ") < shown.index(" serve ")
    assert "Commands" not in shown, "a command belongs to no group"
