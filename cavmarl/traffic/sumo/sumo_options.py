"""SUMO's command line, the same wherever it is run."""

from __future__ import annotations

from pathlib import Path

from cavmarl.core.errors import SumoError, require
from cavmarl.traffic.sumo.sumo_input import SumoInput, without_outputs


def command_words(
    map_file: Path,
    demand: SumoInput,
    folder: Path,
    dt_s: float,
    seed: int,
    more: dict[str, str] | None = None,
    additional: tuple[Path, ...] = (),
) -> list[str]:
    """The words behind the program's name.

    Args:
        map_file: a SUMO network.
        demand: what drives on it.
        folder: for copies of additional files that write nothing.
        dt_s: step length.
        seed: of SUMO's random numbers.
        more: options, which stand above those of the demand's configuration.
        additional: further additional files.
    """
    copies = folder / "additional"
    copies.mkdir(exist_ok=True)
    files = [str(without_outputs(path, copies)) for path in demand.additional_files]
    routes = [str(without_outputs(path, copies)) for path in demand.route_files]
    options = demand.options | {
        "net-file": str(map_file),
        "route-files": ",".join(routes),
        "additional-files": ",".join([*files, *map(str, additional)]),
        "begin": str(demand.begin_s),
        "step-length": repr(dt_s),
        "seed": str(seed),
        "no-step-log": "true",
        "no-warnings": "true",
        "duration-log.disable": "true",
        "xml-validation": "never",
        **(more or {}),
    }
    return [f"--{name}={value}" for name, value in options.items() if value]


def free_libsumo() -> object:
    """This process's libsumo, in which nothing runs.

    Raises:
        MissingExtraError: it is not installed.
        SumoError: a simulation runs in it: a second start would silently replace it.
    """
    libsumo = require("libsumo", "sumo")
    if libsumo.isLoaded():
        raise SumoError(
            "libsumo holds one simulation a process, and one runs in this one: close it, or start "
            "the other one in a process of its own"
        )
    return libsumo
