"""The settings of a training program as options of its command line.

A program's settings are one frozen dataclass; each field is an option, typed and described by its
`Annotated[type, "text"]`.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from cavmarl.config.io import read_yaml, validate
from cavmarl.core.errors import CavmarlError, ConfigError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RESUME = "folder of a run to go on with; its settings hold but for the length"
DRIVER = "driver: {folder}  (cavmarl evaluate ENV --policy {folder})"

S = TypeVar("S", bound="DataclassInstance")


def parse_settings(kind: type[S], words: Sequence[str] | None, text: str | None) -> S:
    """The settings that the command line asks for.

    `--config FILE` is a YAML file of the same settings, which options shadow.

    `words` are those of the command line; None: this process's. The first line of `text`, which
    says what the program is, is shown.
    """
    return settings_of(kind, given_options(kind, words, text))


def given_options(
    kind: type[DataclassInstance], words: Sequence[str] | None, text: str | None
) -> dict[str, Any]:
    """Only what the command line says, by name; `config` is a file. Arguments as above."""
    parser = argparse.ArgumentParser(
        description=(text or "").partition("\n")[0], argument_default=argparse.SUPPRESS
    )
    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        of, meaning = get_args(hints[field.name])
        action: Any = argparse.BooleanOptionalAction if of is bool else "store"
        extra = {} if of is bool else {"type": of, "metavar": of.__name__.upper()}
        shown = f"{meaning} (default: {field.default!r})"
        parser.add_argument(_option(field.name), action=action, help=shown, **extra)
    parser.add_argument("--config", metavar="FILE", type=Path, help="YAML file of these settings")
    return vars(parser.parse_args(words))


def settings_of(kind: type[S], given: Mapping[str, Any]) -> S:
    options = dict(given)
    path = options.pop("config", None)
    settings = validate(kind, read_yaml(path), str(path)) if path else kind()
    return replace(settings, **options)


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
    """Refuse what torch cannot compute on here; CPUs and NVIDIA's GPUs are supported."""
    import torch  # of its extra; settings that name no device do without

    cure = "give cpu, or cuda on a machine with an NVIDIA GPU and a torch that is built for it"
    if name.partition(":")[0] not in ("cpu", "cuda"):
        raise ConfigError(f"--device {name}: no such device: {cure}")
    try:
        torch.zeros(1, device=name)
    except (RuntimeError, AssertionError) as error:  # torch without CUDA asserts
        reason = str(error).partition("\n")[0].rstrip(".")
        raise ConfigError(f"--device {name}: cannot be used ({reason}): {cure}") from error


def with_form_of(args: S, start: str) -> S:
    """Settings whose network has the form of a driver: `hidden`, `shared`, `residual`.

    `start`: its name or folder; empty: the settings as they are. Raises PolicyError: nothing of
    that name, or no trained driver.
    """
    if not start:
        return args
    from cavmarl.policies.loading import policy_files
    from cavmarl.policies.network_files import read_network  # as above

    form = read_network(policy_files(start)[0].parent)[1]
    own = {"hidden": form.hidden[0], "shared": form.shared, "residual": form.residual}
    return replace(args, **own)


def run_folder(runs: str, name: str, env: str, program: str, seed: int, resume: str = "") -> Path:
    """Where a run lies: RUNS/NAME, without a name RUNS/ENV_PROGRAM_SEED; or RESUME."""
    if resume:
        return Path(resume)
    stem = Path(env).name.split(".")[0]
    return Path(runs) / (name or f"{stem}_{program}_{seed}")


def run_program(train: Callable[[], Path], said: str = DRIVER) -> int:
    """Train, and say where that lies which `train` has made.

    0: trained, 2: wrong use, or what stands in the way; 130: interrupted.
    """
    return run_to_end(
        lambda: print(said.format(folder=train())),
        "--resume goes on from the last checkpoint",
    )


def run_to_end(act: Callable[[], None], goes_on: str) -> int:
    """Do what a program is for; `goes_on` says how it goes on after Ctrl-C.

    0: done, 2: wrong use, or what stands in the way; 130: interrupted.
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


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
