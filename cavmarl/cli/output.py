"""What the commands share: reading overrides, writing JSON, printing errors."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from cavmarl.core.errors import ConfigError
from cavmarl.core.seeds import check_seed

if TYPE_CHECKING:
    from cavmarl.verify.differences import Difference


def writable(path: Path | None) -> Path | None:
    """Refuse a path that cannot be written before any work is done for it."""
    if path is None:
        return None
    if not path.parent.is_dir():
        raise ConfigError(f"--json {path}: cannot be written (there is no folder {path.parent})")
    try:
        there = path.exists()
        with path.open("ab"):
            pass
        if not there:
            path.unlink()
    except OSError as error:
        raise _unwritable(path, error) from error
    return path


def _unwritable(path: Path, error: OSError) -> ConfigError:
    return ConfigError(f"{path}: cannot be written ({error.strerror or error})")


Environment = Annotated[
    str, typer.Argument(metavar="ENV", help="Environment: a name, folder or map file.")
]
PolicyName = Annotated[
    str, typer.Option("--policy", "-p", help="A name of `cavmarl list`, or the path of a policy.")
]
Seed = Annotated[int, typer.Option(help="Root of all random numbers.", callback=check_seed)]
Agents = Annotated[int | None, typer.Option(help="Agents a world; default: the environment's.")]
Background = Annotated[
    int | None, typer.Option(help="Background vehicles a world; default: the environment's.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Any key of env.yaml; may be repeated."),
]
JsonPath = Annotated[
    Path | None,
    typer.Option("--json", help="Write the result here as JSON.", callback=writable),
]


def parse_settings(settings: Sequence[str] | None) -> dict[str, Any]:
    """`sensors.lidar.rays=32` and the like as overrides; a value is JSON, else text.

    Raises:
        ConfigError: no `=`, no key, no value, or a key twice.
    """
    overrides: dict[str, Any] = {}
    for setting in settings or ():
        key, equals, text = setting.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {setting}: must be KEY=VALUE, as sensors.lidar.rays=32")
        if key in overrides:
            raise ConfigError(f"--set {key}: given twice")
        try:
            overrides[key] = json.loads(text)
        except (ValueError, RecursionError):  # not all of JSON's are its own
            overrides[key] = text
        if overrides[key] == "":
            raise ConfigError(f"--set {key}=: has no value")
    return overrides


def make_folder(path: Path) -> None:
    """Make a folder that files can be written into, or see that it is one.

    Raises:
        ConfigError: it cannot be made or written into.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise _unwritable(path, error) from error


def write_json(path: Path | None, document: dict[str, Any]) -> None:
    """Write `document` where `--json` asks for it.

    Raises:
        ConfigError: the path cannot be written.
    """
    if path is None:
        return
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise _unwritable(path, error) from error


def number(value: float | None, scale: float = 1.0) -> str:
    """A number for a table, times `scale`; a dash where there is none."""
    return "-" if value is None else f"{scale * value:.2f}"


def say_difference(difference: Difference, sides: tuple[str, str]) -> str:
    """One sentence: when, whose, and what each of the two sides has."""
    thing = difference.what if difference.vehicle is None else f"vehicle {difference.vehicle}"
    one, other = difference.values
    return (
        f"different: step {difference.step} (tick {difference.tick}), {thing}, "
        f"{difference.field}: {one} {sides[0]}, {other} {sides[1]}"
    )


def print_error(message: str) -> None:
    """Say on stderr, in red, what went wrong; what would steer the terminal is spelled out."""
    shown = "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in message)
    Console(stderr=True).print(Text(f"error: {shown}", style="red"), soft_wrap=True)
