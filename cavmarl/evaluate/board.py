"""The board: a page of drivers whose recorded results were verified by repeating the evaluation.

An entry is a folder NAME with a card (README.md), a finished evaluation of one driver (`result/`,
with a manifest that lists the hashes of the results), and the driver: `model.safetensors`,
`config.json` and the manifest of the training, or a script NAME.py, or a model file of another
library, such as NAME.zip. Without these files, the driver is cavmarl's script of that name. Models
of other libraries are not verified, because their arithmetic differs between processors and
versions; the page marks them.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.config.driver_form import WEIGHTS_FILE, form_of_driver
from cavmarl.config.driver_names import ONNX_FILE, SB3_FILE, TORCH_SCRIPT_FILES
from cavmarl.config.entry_cards import CARD_FILE, sentence_about
from cavmarl.config.registry import agent_entries
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import CavmarlError, ConfigError, ManifestError, PolicyError, require
from cavmarl.core.tracebacks import fault_in
from cavmarl.engine.world_setup import load_world
from cavmarl.evaluate.episodes import Progress
from cavmarl.evaluate.evaluation import load_tables, read_evaluation
from cavmarl.evaluate.provenance.manifest import MANIFEST_FILE, hash_of_file, write_text
from cavmarl.evaluate.statistics import Interval, share_interval
from cavmarl.evaluate.zoo import (
    RESULT_FOLDER,
    SHARES,
    Verification,
    check_weights,
    entry_job,
    verify_result,
)
from cavmarl.policies.loading import policy_files

_PAGE = Path(__file__).with_name("board.html.j2")
NOT_VERIFIED = "not verified"
_MODELS = (SB3_FILE, *TORCH_SCRIPT_FILES, ONNX_FILE)
TITLES = {name: name.replace("_", " ") for name in SHARES}
_CONDITIONS = ("agents", "background", "max_cycles")
# Parts of a result's manifest that are read, by dotted key.
_PARTS: Mapping[str, type] = {
    "policies": dict,
    "results_sha256": dict,
    "seeds": list,
    "episodes": int,
    "world.environment": str,
    "world.config": dict,
    "software.packages": dict,
}


_MISSING = object()


class ShareOfTrips(NamedTuple):
    """A share of trips with its 95 % interval."""

    value: float
    interval: Interval


@dataclass(frozen=True)
class BoardEntry:
    """An entry as the page shows it.

    Attributes:
        name: name of the folder.
        about: first sentence of the card.
        kind: `trained`, `scripted`, or `model` (a model of another library); empty if unknown.
        environment: environment with its version; empty if the result cannot be read.
        conditions: settings that differ from the environment's, for example the number of agents.
        episodes: number of episodes of all runs.
        trips: number of counted trips.
        shares: shares of trips, by the names of `SHARES`.
        digest: SHA-256 of the driver's weights, script or model file.
        version: version of cavmarl that made the result.
        failure: why the entry failed, with the remedy; empty if it did not fail.
    """

    name: str
    about: str
    kind: str = ""
    environment: str = ""
    conditions: str = ""
    episodes: int = 0
    trips: int = 0
    shares: Mapping[str, ShareOfTrips] | None = None
    digest: str = ""
    version: str = ""
    failure: str = ""

    @property
    def state(self) -> str:
        """The state: `failed`, `not verified` or `verified`."""
        return "failed" if self.failure else NOT_VERIFIED if self.kind == "model" else "verified"


def entry_driver(folder: Path) -> Path:
    """Return the driver of an entry: its folder if trained, else the script or the model file.

    Raises:
        PolicyError: the entry has no driver.
    """
    name = folder.name
    if (folder / WEIGHTS_FILE).is_file():
        return folder
    own, ours = folder / f"{name}.py", agent_entries().get(name)
    for file in (own, *(folder / f"{name}{suffix}" for suffix in _MODELS)):
        if file.is_file():
            return file
    if ours is not None and ours.suffix == ".py":
        return ours
    raise PolicyError(
        f"{folder}: has no driver; put model.safetensors and config.json, a script {name}.py or a "
        f"model {name}.zip, .pt, .ts or .onnx into it, or name it after a script of cavmarl"
    )


def check_entry(folder: Path, progress: Progress | None = None) -> Verification:
    """Check that an entry is complete, and that repeating the evaluation gives the same bytes.

    The driver's script, if there is one, is run. A model file of another library is neither read
    nor run: the result then has no hashes and no processors.

    Raises:
        ConfigError: there is no such folder, or no card.
        PolicyError: there is no driver, or it cannot be read.
        ManifestError: a manifest is missing, was written by another version, or describes other
            files; a file was changed; or the repeated evaluation gave other bytes.
    """
    if not folder.is_dir():
        raise ConfigError(f"{folder}: is not a folder; give the folder of an entry")
    folder = folder.resolve()  # replaces `.` by the folder's real name
    if not (folder / CARD_FILE).is_file():
        raise ConfigError(f"{folder}: has no {CARD_FILE}; write a card that describes the driver")
    driver = entry_driver(folder)
    if driver == folder:
        _check_training(folder)
    document = _read_result(folder, driver)
    if driver.suffix in _MODELS:
        check_weights(document, folder.name, policy_files(driver))
        return Verification(folder.name, {}, {}, "", "")
    try:
        found = verify_result(folder, driver, progress)
    except SystemExit as error:  # else a script could end the check as if it had passed
        raise PolicyError(f"{driver}: ends the program ({error!r}); remove this call") from error
    if found.differing:
        raise ManifestError(
            f"{folder / RESULT_FOLDER}: {', '.join(found.differing)} of the evaluation repeated on "
            f"{found.found_on} differ from those made on {found.expected_on}; check that the "
            "driver uses no clock and no random numbers other than from `reset(seed)`, and "
            "evaluate it again with this version"
        )
    return found


def entries_in(folders: Iterable[Path], only: Collection[str] = ()) -> list[Path]:
    """Return the folders of entries: all subfolders with a result, a card or weights.

    Args:
        folders: folders of entries.
        only: names of the wanted entries; empty: all.

    Raises:
        ConfigError: a folder does not exist, there are no entries, two entries have the same name,
            or a wanted entry is missing.
    """
    found: dict[str, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ConfigError(f"{folder}: is not a folder; give folders that contain entries")
        for path in sorted(folder.iterdir()):
            if not any((path / name).exists() for name in (RESULT_FOLDER, CARD_FILE, WEIGHTS_FILE)):
                continue
            if path.name in found:
                raise ConfigError(
                    f"{path}: has the same name as {found[path.name]}; rename one of the two"
                )
            found[path.name] = path
    if missing := [name for name in only if name not in found]:
        raise ConfigError(
            f"--entry {missing[0]}: there is no such entry; there are {', '.join(found) or 'none'}"
        )
    if not found:
        raise ConfigError(
            f"{', '.join(map(str, folders))}: contains no entries; an entry is a folder with "
            f"{CARD_FILE}, a driver and {RESULT_FOLDER}/"
        )
    return [path for name, path in found.items() if not only or name in only]


def build_board(
    entries: Sequence[Path], out: Path, progress: Progress | None = None
) -> list[BoardEntry]:
    """Check each entry and write the page; an entry that fails is marked with the reason.

    Args:
        entries: folders of the entries.
        out: file of the page.
        progress: as in `evaluate`.

    Raises:
        MissingExtraError: Jinja2 is not installed.
        ManifestError: the page cannot be written.
    """
    jinja2 = require("jinja2", "report")
    found = [_entry(folder, progress) for folder in entries]
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string(_PAGE.read_text(encoding="utf-8"))
    verified = sum(entry.state == "verified" for entry in found)
    page = template.render(
        groups=_groups(found),
        unread=[entry for entry in found if not entry.environment],
        titles=TITLES,
        entries=len(found),
        verified=verified,
    )
    write_text(out, page)
    return found


def _read_result(folder: Path, driver: Path) -> dict[str, Any]:
    """Return the manifest of an entry's result; raises as `check_entry`."""
    result = folder / RESULT_FOLDER
    document = read_evaluation(result)
    for key, kind in _PARTS.items():
        part: Any = document
        for name in key.split("."):
            part = part.get(name, _MISSING) if isinstance(part, dict) else _MISSING
        if not isinstance(part, kind):
            raise ManifestError(
                f"{result / MANIFEST_FILE}: {key} is missing or damaged; evaluate this driver again"
            )
    if len(document["policies"]) != 1:
        raise ManifestError(
            f"{result}: has {len(document['policies'])} drivers; evaluate this driver alone: "
            f"cavmarl evaluate ENV --policy {driver} --out {result}"
        )
    return document


def _entry(folder: Path, progress: Progress | None) -> BoardEntry:
    """Check an entry; keep the reason if it fails."""
    failure = ""
    try:
        check_entry(folder, progress)
    except CavmarlError as error:
        failure = str(error)
    except Exception as error:  # the script of an entry may raise any exception
        failure = f"{fault_in(folder, error)}; correct the script"
    try:
        return _described(folder, failure)
    except Exception as error:  # a damaged result must not prevent the page of other entries
        failure = failure or f"its result cannot be shown ({error}); evaluate the driver again"
        return BoardEntry(folder.name, sentence_about(folder), failure=failure)


def _described(folder: Path, failure: str) -> BoardEntry:
    driver = entry_driver(folder)
    result = folder / RESULT_FOLDER
    document = _read_result(folder, driver)
    trips, _ = load_tables(result)[next(iter(document["policies"]))]
    counted = trips[trips["counted"]]
    job = entry_job(document, folder)
    is_endless = load_world(job.world.env, **job.world.keywords).config.traffic.endless
    shares = {}
    for name in SHARES:
        if name == "success" and is_endless:  # no vehicle arrives
            continue
        hits, total = int(counted[name].sum()), len(counted)
        if interval := share_interval(hits, total):
            shares[name] = ShareOfTrips(hits / total, interval)
    return BoardEntry(
        folder.name,
        sentence_about(folder),
        "trained" if driver == folder else "model" if driver.suffix in _MODELS else "scripted",
        document["world"]["environment"],
        _conditions(job.world, driver if driver == folder else None),
        document["episodes"] * len(document["seeds"]),
        len(counted),
        shares,
        hash_of_file(policy_files(driver)[0]),
        document["software"]["packages"].get("cavmarl", "unknown"),
        failure,
    )


def _conditions(spec: WorldSpec, trained: Path | None) -> str:
    """Return settings that replace the environment's, except a driver's own sensors and actions."""
    own = {} if trained is None else form_of_driver(trained)
    given = {name: getattr(spec, name) for name in _CONDITIONS}
    told = [f"{name} {value}" for name, value in given.items() if value is not None]
    told += [
        f"{key} = {json.dumps(value)}"
        for key, value in sorted((spec.overrides or {}).items())
        if key not in own
    ]
    return ", ".join(told)


def _check_training(folder: Path) -> None:
    """Raise ManifestError unless the manifest of the training names the weights."""
    path = folder / MANIFEST_FILE
    try:
        known = json.loads(path.read_text(encoding="utf-8"))["results_sha256"][WEIGHTS_FILE]
    except (OSError, ValueError, LookupError, TypeError, RecursionError) as error:
        raise ManifestError(
            f"{path}: does not name the trained weights ({type(error).__name__}); copy the "
            "manifest of the training run's folder"
        ) from error
    if known != hash_of_file(folder / WEIGHTS_FILE):
        raise ManifestError(
            f"{folder / WEIGHTS_FILE}: is not the file that {path} names; copy both from the "
            "folder of one training run"
        )


def _groups(entries: Iterable[BoardEntry]) -> dict[str, list[BoardEntry]]:
    """Return the entries of each environment and conditions, the most successful first.

    Entries that failed or are not verified come last, because their figures are unproven.
    """
    groups: dict[str, list[BoardEntry]] = {}
    for entry in entries:
        if entry.environment:
            heading = ", ".join(filter(None, (entry.environment, entry.conditions)))
            groups.setdefault(heading, []).append(entry)
    for group in groups.values():
        group.sort(key=_rank)
    return dict(sorted(groups.items()))


def _rank(entry: BoardEntry) -> tuple[int, float, float, str]:
    shares = entry.shares or {}
    success, collision = (
        shares[name].value if name in shares else 0.0 for name in ("success", "collision")
    )
    order = ("verified", NOT_VERIFIED, "failed")
    return order.index(entry.state), -success, collision, entry.name
