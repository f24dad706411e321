"""What the commands share: reading overrides, writing JSON, printing errors."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from functools import partial, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, get_type_hints

import typer
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from cavmarl.bench.harness import check_positive
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError
from cavmarl.core.seeds import check_seed

if TYPE_CHECKING:
    from cavmarl.recordings.extra_tables import RecordOptions
    from cavmarl.verify.differences import Difference

Made = TypeVar("Made")


def _writable(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Refuse a path that cannot be written before any work is done for it."""
    if path is None:
        return None
    if not path.parent.is_dir():
        raise ConfigError(
            f"{option.opts[0]} {path}: cannot be written (there is no folder {path.parent})"
        )
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


def check_bound(value: float | None) -> float | None:
    """Refuse a value of `--at-least` that nothing can be measured against."""
    check_positive("--at-least", value)
    return value


def about(text: str, *names: str, **more: Any) -> Any:
    """An option with a help text."""
    return typer.Option(*names, help=text, **more)


def about_file(text: str, *names: str) -> Any:
    """An option that takes a file to write, which is tried at once."""
    return about(text, *names, callback=_writable)


Backend = Annotated[
    str | None,
    about(
        "Where the worlds run: local, processes:N, nodes:N, nodes:N@HOST:PORT, nodes:N@mpi, ray:N "
        "or ray [default: local]."
    ),
]
Workers = Annotated[int | None, about("Short form: N for --backend processes:N, 0 for local.")]
Environment = Annotated[
    str, typer.Argument(metavar="ENV", help="Environment: a name, folder or map file.")
]
OptionalEnvironment = Annotated[
    str, typer.Argument(metavar="[ENV]", help="Name, folder or map file of an environment.")
]
MapName = Annotated[
    str, typer.Argument(metavar="MAP", help="A map file, or an environment's name or folder.")
]
PolicyName = Annotated[
    str, about("A name of `cavmarl list`, or a policy's path.", "--policy", "-p")
]
Seed = Annotated[int, about("Root of all random numbers.", callback=check_seed)]
Agents = Annotated[int | None, about("Agents a world; default: the environment's.")]
Background = Annotated[int | None, about("Background vehicles a world; default: likewise.")]
Settings = Annotated[
    list[str] | None, about("Any key of env.yaml; may be repeated.", "--set", metavar="KEY=VALUE")
]
SensorsOf = Annotated[
    str | None,
    about("Give the agents the sensors and actions of this trained driver.", metavar="DRIVER"),
]
JsonPath = Annotated[Path | None, about_file("Write the result here as JSON.", "--json")]
RecordPath = Annotated[
    Path | None, about("Record into this new folder, for `cavmarl replay`.", "--record")
]
RecordAlso = Annotated[
    str, about("Record these, too: observations, samples, messages; with commas.", "--record-also")
]
AtLeast = Annotated[
    float | None, about("Exit with 1 if it is not so many times as fast.", callback=check_bound)
]


def recorded(path: Path | None, also: str) -> RecordOptions | None:
    """What `--record` and `--record-also` ask for; None: nothing.

    Raises ConfigError: more is to be recorded, but not where.
    """
    include = tuple(name.strip() for name in also.split(",") if name.strip())
    if path is None:
        if include:
            raise ConfigError(f"--record-also {also}: say where, with --record FOLDER")
        return None
    from cavmarl.recordings.extra_tables import RecordOptions

    return RecordOptions(path, include)


def with_world(*names: str) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Makes a command of a function that takes a `world: WorldSpec`.

    In its place stand the options that make one: all, or the environment and those of these names.
    Where the function has one of them, too, it says how it is given, and gets it.
    """
    chosen = names or ("agents", "background", "seed", "settings", "sensors_of")
    return partial(_with_world, ("env", *chosen))


def _with_world(names: tuple[str, ...], command: Callable[..., Made]) -> Callable[..., Made]:
    own = dict(signature(command).parameters)
    hints = get_type_hints(command, include_extras=True)
    shared = {
        "env": (Environment, Parameter.empty),
        "seed": (Seed, 0),
        "agents": (Agents, None),
        "background": (Background, None),
        "settings": (Settings, None),
        "sensors_of": (SensorsOf, None),
    }
    wanted = {
        name: Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in shared.items()
        if name in names
    }
    del own["world"]
    for name, one in own.items():
        wanted[name] = one.replace(annotation=hints[name], kind=Parameter.KEYWORD_ONLY)

    @wraps(command)
    def program(**options: Any) -> Made:
        keys = {name: options[name] for name in names if name != "settings"}
        env = keys.pop("env") or ""
        spec = WorldSpec.of(env, overrides=parse_settings(options["settings"]), **keys)
        return command(spec, **{name: options[name] for name in own})

    program.__annotations__ = {name: one.annotation for name, one in wanted.items()}
    vars(program)["__signature__"] = Signature(list(wanted.values()))
    return program


def parse_settings(settings: Sequence[str] | None) -> dict[str, Any]:
    """`sensors.lidar.rays=32` and the like as overrides; a value is JSON, else text."""
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
    """Make a folder that files can be written into, or see that it is one."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise _unwritable(path, error) from error


def write_json(path: Path | None, document: dict[str, Any]) -> None:
    """Write `document` where `--json` asks for it."""
    if path is None:
        return
    try:
        path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise _unwritable(path, error) from error


def number(value: float | None, scale: float = 1.0) -> str:
    """A number for a table, times `scale`; a dash where there is none."""
    return "-" if value is None else f"{scale * value:.2f}"


def grid(
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str | None = None,
    caption: str | None = None,
    lefts: int = 1,
    wraps: bool = False,
) -> Table:
    """A table without a frame; all columns but the first `lefts` are right-aligned numbers."""
    table = Table(title=title, caption=caption, box=box.SIMPLE_HEAD, pad_edge=False)
    for place, head in enumerate(heads):
        if place < lefts:
            table.add_column(head, overflow="fold")
        else:
            table.add_column(head, justify="right", no_wrap=not wraps)
    for row in rows:
        table.add_row(*row)
    return table


def pairs_grid(rows: Iterable[tuple[str, str]]) -> Table:
    """Names and what is told of them, without a head."""
    table = Table.grid(padding=(0, 2))
    for row in rows:
        table.add_row(*row)
    return table


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
