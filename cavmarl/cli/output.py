"""Parts that commands share: world options, overrides, tables, JSON files and error messages."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextvars import ContextVar
from datetime import datetime
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
from typer.core import TyperCommand, TyperGroup

from cavmarl.bench.harness import check_positive
from cavmarl.config.driver_names import ONNX_FILE, SB3_FILE, TORCH_SCRIPT_FILES, drivers_in
from cavmarl.config.registry import SUMO_PREFIX, is_converted, load_config
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, require_all
from cavmarl.core.extensions import import_plugins
from cavmarl.core.seeds import check_seed
from cavmarl.viewer.web_options import PACKAGES

if TYPE_CHECKING:
    from cavmarl.recordings.extra_tables import RecordOptions
    from cavmarl.verify.differences import Difference

Made = TypeVar("Made")


_WRITER: ContextVar[str] = ContextVar("command whose results are written as JSON")


def _json_file(
    context: typer.Context, option: typer.CallbackParam, path: Path | None
) -> Path | None:
    """Store the name of the command for `write_json`, and check that the file can be written."""
    program, *words = context.command_path.split()
    _WRITER.set(" ".join(word for word in words if not word.startswith("-")) or program)
    return _writable(option, path)


def _writable(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Raise ConfigError before the command starts if `path` cannot be written."""
    if path is None:
        return None
    if not path.parent.is_dir():
        raise ConfigError(
            f"{option.opts[0]} {path}: cannot be written: there is no folder {path.parent}; create "
            "it, or name another file"
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
    return ConfigError(f"{path}: cannot be written: {error.strerror or error}")


def check_bound(value: float | None) -> float | None:
    """Return the value of `--at-least`; raise ConfigError unless it is positive."""
    check_positive("--at-least", value)
    return value


def _import_all(modules: list[str] | None) -> list[str] | None:
    """Import the modules before any other option uses what they register."""
    import_plugins(modules or ())
    return modules


# Optional modules that outputs need, with the extras that install them.
PAGE_EXTRAS = {"matplotlib": "report", "jinja2": "report"}
WINDOW_EXTRAS = {"pygame": "render"}
VIDEO_EXTRAS = WINDOW_EXTRAS | {"imageio_ffmpeg": "render"}
WEB_EXTRAS = dict.fromkeys(PACKAGES, "viewer")
RECORD_EXTRAS = {"pyarrow": "record"}
DRIVER_EXTRAS: dict[str, dict[str, str]] = {  # suffix of a model file → its extras
    SB3_FILE: {"stable_baselines3": "train", "torch": "train"},
    **{suffix: {"torch": "train"} for suffix in TORCH_SCRIPT_FILES},
    ONNX_FILE: {"onnxruntime": "onnx"},
}

# Groups of options in the help.
WORLD, RUN, OUTPUT, PAGE, SERVICE = "World", "Where it runs", "Output", "Page", "Service"


def about(text: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """Return an option with a help text; `panel` is the group in which the help shows it.

    If the text ends in "[default: …].", that is shown in place of the default of the parameter.
    """
    text, told, default = text.removesuffix("].").partition(" [default: ")
    if told:
        text, more["show_default"] = f"{text}.", default
    return typer.Option(*names, help=text, rich_help_panel=panel, **more)


def flag(text: str, *names: str, panel: str | None = None, **more: Any) -> Any:
    """Return an option without a value."""
    return about(text, *names, panel=panel, metavar="", **more)


def about_file(text: str, *names: str, metavar: str = "FILE") -> Any:
    """Return an option for an output file, which is opened for writing before the command runs."""
    return about(text, *names, metavar=metavar, callback=_writable, panel=OUTPUT)


class CliCommand(TyperCommand):
    """A command whose help shows flags without a value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, and `--help`."""
        return _without_flag_values(super().get_params(ctx))


class CliGroup(TyperGroup):
    """A group of commands whose help shows flags without a value."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the parameters, and `--help`."""
        return _without_flag_values(super().get_params(ctx))


def _without_flag_values(params: Iterable[Any]) -> list[Any]:
    """Return the parameters of a command; Typer would show `--help` with the value `<bool>`."""
    found = list(params)
    for each in found:
        if getattr(each, "is_flag", False) and each.metavar is None:
            each.metavar = ""
    return found


def add_command(
    app: typer.Typer,
    name: str,
    command: Callable[..., None],
    *examples: str,
    panel: str | None = None,
    **settings: Any,
) -> None:
    """Add a command whose help ends with examples; `panel` is its group in the help of `app`."""
    end = "\n\n".join(("Examples:", *examples))
    app.command(name, cls=CliCommand, rich_help_panel=panel, epilog=end, context_settings=settings)(
        command
    )


Backend = Annotated[
    str | None,
    about(
        "Where the worlds run: local, processes:N, nodes:N, nodes:N@HOST:PORT, nodes:N@mpi, ray:N "
        "or ray [default: local].",
        metavar="BACKEND",
        panel=RUN,
    ),
]
Workers = Annotated[
    int | None,
    about("Short form of --backend processes:N; 0 means local.", metavar="N", panel=RUN),
]
Environment = Annotated[
    str,
    typer.Argument(
        metavar="ENV", help="Environment: its name, its folder, a map file or a .sumocfg."
    ),
]
OptionalEnvironment = Annotated[
    str,
    typer.Argument(
        metavar="ENV", help="Environment: its name, its folder, a map file or a .sumocfg."
    ),
]
MapName = Annotated[
    str,
    typer.Argument(
        metavar="MAP", help="Map file, .sumocfg, or the name or folder of an environment."
    ),
]
PolicyName = Annotated[
    str,
    about(
        "Driver of the agents: a name from `cavmarl list`, a folder, a .py file, or a model file "
        "(.zip of stable-baselines3, .pt of TorchScript, .onnx).",
        "--policy",
        "-p",
        metavar="POLICY",
    ),
]
Policies = Annotated[
    list[str] | None,
    about(
        "Driver to evaluate: a name from `cavmarl list`, a folder, a .py file, or a model file "
        "(.zip of stable-baselines3, .pt of TorchScript, .onnx). Repeat the option to compare "
        "drivers with the first one [default: idm].",
        "--policy",
        "-p",
        metavar="POLICY",
    ),
]
Seed = Annotated[
    int, about("Seed of all random numbers.", metavar="N", callback=check_seed, panel=WORLD)
]
Agents = Annotated[
    int | None,
    about(
        "Number of agents in each world [default: as configured by the environment].",
        metavar="N",
        panel=WORLD,
    ),
]
Background = Annotated[
    int | None,
    about(
        "Number of background vehicles in each world [default: as configured by the environment].",
        metavar="N",
        panel=WORLD,
    ),
]
Zones = Annotated[
    int | None,
    about(
        "Number of zones of each world [default: as configured by the environment].",
        metavar="K",
        panel=WORLD,
    ),
]
Imports = Annotated[
    list[str] | None,
    about(
        "Import this module first; it may register terms, sensors, driver models or backends. "
        "Repeat it for more modules.",
        "--import",
        metavar="MODULE",
        callback=_import_all,
        panel=WORLD,
    ),
]
Settings = Annotated[
    list[str] | None,
    about(
        "Override a key of env.yaml, for example sensors.lidar.rays=32. Repeat it for more keys.",
        "--set",
        metavar="KEY=VALUE",
        panel=WORLD,
    ),
]
SensorsOf = Annotated[
    str | None,
    about(
        "Give the agents the sensors and actions of this trained driver.",
        metavar="DRIVER",
        panel=WORLD,
    ),
]
Episodes = Annotated[int, about("Number of episodes of each run.", "--episodes", "-n", metavar="N")]
Repeats = Annotated[
    int,
    about("Number of independent runs, each in a new process.", "--repeats", "-r", metavar="N"),
]
NewFolder = Annotated[
    Path | None,
    about("New folder for the results [default: a folder in runs/].", metavar="DIR", panel=OUTPUT),
]
JsonPath = Annotated[
    Path | None,
    about(
        "Write the result to this file as JSON.",
        "--json",
        metavar="FILE",
        callback=_json_file,
        panel=OUTPUT,
    ),
]
RecordPath = Annotated[
    Path | None,
    about(
        "Record the run in this new folder; `cavmarl replay` plays it.",
        "--record",
        metavar="DIR",
        panel=OUTPUT,
    ),
]
RecordAlso = Annotated[
    str,
    about(
        "Additional data to record, comma-separated: observations, samples, messages, commands.",
        "--record-also",
        metavar="NAME,…",
        panel=OUTPUT,
    ),
]
AtLeast = Annotated[
    float | None,
    about(
        "Exit with 1 if the ratio of speeds is below X.",
        metavar="X",
        callback=check_bound,
        panel=OUTPUT,
    ),
]


def backend_text(backend: str | None, workers: int | None) -> str:
    """Return where worlds run, from an option and its short form. Raises ConfigError."""
    from cavmarl.parallel.backends import find_backend

    return str(find_backend(backend, workers))


def recorded(path: Path | None, also: str) -> RecordOptions | None:
    """Return the options of the recording that the command line asks for, or None.

    Raises ConfigError if `--record-also` is given without `--record`.
    """
    include = tuple(name.strip() for name in also.split(",") if name.strip())
    if path is None:
        if include:
            raise ConfigError(f"--record-also {also}: goes with --record; add --record FOLDER")
        return None
    from cavmarl.recordings.extra_tables import RecordOptions

    return RecordOptions(path, include)


def check_extras(
    world: WorldSpec, policies: Iterable[str], *needed: tuple[object, Mapping[str, str]]
) -> None:
    """Raise one MissingExtraError for all modules that a command lacks, before it does any work.

    Args:
        world: the world to make, which may need SUMO.
        policies: drivers, which may need the library of a model file.
        needed: the value of an option, and the modules (with their extras) that it needs if set.
    """
    config, _ = load_config(world.env, **world.keywords)
    modules: dict[str, str] = {}
    if any(name.startswith(SUMO_PREFIX) or is_converted(name) for name in config.map.sources):
        modules["sumo"] = "sumo"
    if config.traffic.source != "native":
        modules["libsumo"] = "sumo"
    for policy in policies:
        for driver in drivers_in(policy):
            modules |= DRIVER_EXTRAS.get(Path(driver).suffix, {})
    for value, extras in needed:
        modules |= extras if value else {}
    require_all(modules)


def with_world(
    *names: str, is_here: bool = True
) -> Callable[[Callable[..., Made]], Callable[..., Made]]:
    """Return a decorator for commands that take a `world: WorldSpec`.

    On the command line, `world` is replaced by the options that define it: ENV, --import and the
    options in `names`, by default all. If the function has a parameter with the name of such an
    option, the declaration of the parameter is used, and the function also receives the value.

    `is_here`: whether the world is made in this process; otherwise, --import is not offered.
    """
    chosen = names or ("agents", "background", "seed", "settings", "sensors_of")
    return partial(_with_world, ("env", *chosen, *(("imports",) if is_here else ())))


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
        "imports": (Imports, None),
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
        keys = {name: options[name] for name in names if name not in ("settings", "imports")}
        env = keys.pop("env") or ""
        overrides = parse_settings(options["settings"], options.get("imports"))
        spec = WorldSpec.of(env, overrides=overrides, **keys)
        return command(spec, **{name: options[name] for name in own})

    program.__annotations__ = {name: one.annotation for name, one in wanted.items()}
    vars(program)["__signature__"] = Signature(list(wanted.values()))
    return program


def parse_settings(
    settings: Sequence[str] | None, imports: Sequence[str] | None = None
) -> dict[str, Any]:
    """Return overrides from texts like `sensors.lidar.rays=32`, with the imports as `plugins`.

    A value that is not JSON is kept as text. Raises ConfigError if a text is not KEY=VALUE or has
    no value, or if two texts have the same key.
    """
    overrides: dict[str, Any] = {}
    for setting in settings or ():
        key, equals, text = setting.partition("=")
        if not equals or not key:
            raise ConfigError(
                f"--set {setting}: must be KEY=VALUE, for example sensors.lidar.rays=32"
            )
        if key in overrides:
            raise ConfigError(f"--set {key}: the key is given twice; keep one of them")
        try:
            overrides[key] = json.loads(text)
        except (ValueError, RecursionError):  # deeply nested JSON exhausts the stack
            overrides[key] = text
        if overrides[key] == "":
            raise ConfigError(f"--set {key}=: the value is missing; write KEY=VALUE")
    if imports:
        if "plugins" in overrides:
            raise ConfigError("--set plugins with --import: name all modules with --import")
        overrides["plugins"] = list(imports)
    return overrides


def make_folder(path: Path) -> None:
    """Create a folder unless it exists; raise ConfigError if no file can be written there."""
    try:
        path.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=path):
            pass
    except OSError as error:
        raise _unwritable(path, error) from error


def results_folder(out: Path | None, command: str, where: str) -> Path:
    """Return the folder given by `--out`, or the name of a new folder in runs/ for this command.

    Raises:
        ConfigError: the folder has files.
    """
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S-%f")
    folder = out or Path("runs") / command / f"{Path(where).name.split('.')[0]}-{stamp}"
    if folder.exists() and any(folder.iterdir()):
        raise ConfigError(f"--out {folder}: the folder is not empty; name a new folder")
    return folder


def write_json(path: Path | None, document: dict[str, Any]) -> None:
    """Write `document` to the file given by `--json`, if there is one.

    The first entry, `kind`, is the command that wrote it, for example `bench step`.
    """
    if path is None:
        return
    kinded = {"kind": _WRITER.get(), **document}
    try:
        path.write_text(json.dumps(kinded, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise _unwritable(path, error) from error


def number(value: float | None, scale: float = 1.0) -> str:
    """Return `scale * value` for a table cell, or a dash for None."""
    return "-" if value is None else f"{scale * value:.2f}"


def grid(
    heads: Sequence[str],
    rows: Iterable[Sequence[str]],
    title: str | None = None,
    caption: str | None = None,
    lefts: int = 1,
    wraps: bool = False,
) -> Table:
    """Return a table without a frame; the columns after the first `lefts` are right-aligned."""
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
    """Return a table of names and values without a heading."""
    table = Table.grid(padding=(0, 2))
    for row in rows:
        table.add_row(*row)
    return table


def say_difference(difference: Difference, sides: tuple[str, str]) -> str:
    """Return a sentence that says where two runs first differ, with both values."""
    thing = difference.what if difference.vehicle is None else f"vehicle {difference.vehicle}"
    one, other = difference.values
    return (
        f"different: step {difference.step} (tick {difference.tick}), {thing}, "
        f"{difference.field}: {one} {sides[0]}, {other} {sides[1]}"
    )


def print_error(message: str) -> None:
    """Print an error to stderr in red; control characters are escaped."""
    shown = "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in message)
    Console(stderr=True).print(Text(f"error: {shown}", style="red"), soft_wrap=True)


def driving_progress(bar: Any) -> Callable[[str, int, int], None]:
    """Return a function that shows the progress of a policy's run in a bar."""
    task = bar.add_task("")

    def show(policy: str, steps: int, most: int) -> None:
        bar.update(task, description=policy, completed=steps, total=most)

    return show
