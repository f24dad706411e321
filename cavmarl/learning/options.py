"""The settings of a training program as command line options.

A program's settings are one frozen dataclass. Each field is an option; its type and help text come
from `Annotated[type, "text"]`.
"""

from __future__ import annotations

import argparse
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from cavmarl.config.io import read_yaml, validate
from cavmarl.core.errors import CavmarlError, ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RESUME = "folder of a run to continue; its settings apply, except for its length"
LOGGERS = "trackers that log the run: tensorboard, wandb, mlflow; comma-separated"
DRIVER = "driver: {folder}  (cavmarl evaluate ENV --policy {folder})"

PLUGINS = "plugins"  # setting of the option --import, which can be repeated

S = TypeVar("S", bound="DataclassInstance")


def parse_settings(kind: type[S], words: Sequence[str] | None, text: str | None) -> S:
    """Parse the settings from the command line.

    `--config FILE` is a YAML file of the same settings; options take precedence.

    `words`: arguments of the command line; None: those of this process. `text`: its first line is
    shown as the description of the program.
    """
    return settings_of(kind, given_options(kind, words, text))


def given_options(
    kind: type[DataclassInstance], words: Sequence[str] | None, text: str | None
) -> dict[str, Any]:
    """Return only the given options, by name; `config` is a file. See `parse_settings`."""
    parser = argparse.ArgumentParser(
        description=(text or "").partition("\n")[0], argument_default=argparse.SUPPRESS
    )
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        of, meaning = get_args(hints[field.name])
        action: Any = argparse.BooleanOptionalAction if of is bool else "store"
        if field.name == PLUGINS:
            action = "append"
        extra = {} if of is bool else {"type": of, "metavar": of.__name__.upper()}
        shown = f"{meaning} (default: {field.default!r})"
        option = _option(field.name)
        parser.add_argument(option, dest=field.name, action=action, help=shown, **extra)
    parser.add_argument("--config", metavar="FILE", type=Path, help="YAML file of these settings")
    given = vars(parser.parse_args(words))
    if PLUGINS in given:
        given[PLUGINS] = ",".join(given[PLUGINS])
    return given


def settings_of(kind: type[S], given: Mapping[str, Any]) -> S:
    options = dict(given)
    path = options.pop("config", None)
    settings = validate(kind, read_yaml(path), str(path)) if path else kind()
    return replace(settings, **options)


def split_settings(text: str) -> list[str]:
    """Return the parts KEY=VALUE of a comma-separated text; values may be JSON with commas."""
    return [word for word in re.split(r",(?=[\w.]+=)", text.strip(",")) if word]


def check_at_least(settings: object, least: Mapping[str, float]) -> None:
    for name, bound in least.items():
        value = getattr(settings, name)
        if not bound <= value < float("inf"):
            raise ConfigError(f"{_option(name)} {value}: must be at least {bound}")


def check_above_zero(settings: object, names: Iterable[str]) -> None:
    for name in names:
        value = getattr(settings, name)
        if not 0.0 < value < float("inf"):
            raise ConfigError(f"{_option(name)} {value}: must be above 0")


def check_shares(settings: object, names: Iterable[str]) -> None:
    for name in names:
        value = getattr(settings, name)
        if not 0.0 <= value <= 1.0:
            raise ConfigError(f"{_option(name)} {value}: must be from 0 to 1")


def check_device(name: str) -> None:
    """Check that torch can use the device; CPUs and NVIDIA GPUs are supported."""
    import torch  # an optional package; settings without a device do not need it

    cure = "give cpu, or cuda on a machine with an NVIDIA GPU and a torch build that supports it"
    if name.partition(":")[0] not in ("cpu", "cuda"):
        raise ConfigError(f"--device {name}: unknown device; {cure}")
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ConfigError(f"--device {name}: cannot be used ({reason}); {cure}") from error


def with_form_of(args: S, start: str) -> S:
    """Return settings with the network architecture of a driver: `hidden`, `shared`, `residual`.

    `start`: the driver's name or folder; empty: the settings are returned unchanged. Raises
    PolicyError: the driver does not exist, or is not a trained driver.
    """
    if not start:
        return args
    from cavmarl.networks.network_files import read_network  # optional package
    from cavmarl.policies.loading import policy_files

    form = read_network(policy_files(start)[0].parent)[1]
    own = {"hidden": form.hidden[0], "shared": form.shared, "residual": form.residual}
    return replace(args, **own)


def run_folder(runs: str, name: str, env: str, program: str, seed: int, resume: str = "") -> Path:
    """Return the folder of a run: RUNS/NAME, or without a name RUNS/ENV_PROGRAM_SEED; or RESUME."""
    if resume:
        return Path(resume)
    stem = Path(env).name.split(".")[0]
    return Path(runs) / (name or f"{stem}_{program}_{seed}")


def run_program(train: Callable[[], Path], message: str = DRIVER) -> int:
    """Train, print a message with the folder that `train` returns, and return the exit code.

    An empty message is not printed. 0: trained; 2: wrong usage or an error; 130: interrupted.
    """
    end = "\n" if message else ""
    return run_to_end(
        lambda: print(message.format(folder=train()), end=end),
        "use --resume to continue from the last checkpoint",
    )


def run_to_end(act: Callable[[], None], goes_on: str) -> int:
    """Run `act` and return the exit code; `goes_on` is printed after Ctrl-C.

    0: done; 2: wrong usage or an error; 130: interrupted.
    """
    try:
        act()
    except CavmarlError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"interrupted: {goes_on}", file=sys.stderr)
        return 130
    return 0


@contextmanager
def noting_sigterm() -> Iterator[Callable[[], bool]]:
    """Keep SIGTERM from ending the code inside; yield a function that tells whether it has arrived.

    A second SIGTERM ends the program at once.
    """
    came: list[int] = []

    def note(number: int, _: object) -> None:
        came.append(number)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)

    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.signal(signal.SIGTERM, note)
    try:
        yield lambda: bool(came)
    finally:
        signal.signal(signal.SIGTERM, before)


def _option(name: str) -> str:
    return "--import" if name == PLUGINS else f"--{name.replace('_', '-')}"
