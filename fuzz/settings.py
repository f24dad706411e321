"""Targets for settings and records: environments, overrides, drivers, checkpoints, plans."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

import torch

from cavmarl.balance.balance_plan import make_plan, replan
from cavmarl.balance.load_snapshot import idle_snapshot
from cavmarl.balance.plan_file import read_plan
from cavmarl.balance.plan_text import describe_plan
from cavmarl.balance.problem import Problem, equal_costs
from cavmarl.cli.output import parse_settings
from cavmarl.config.action import ActionConfig
from cavmarl.config.driver_form import CONFIG_FILE, WEIGHTS_FILE
from cavmarl.config.env import EnvConfig
from cavmarl.config.io import read_yaml, validate
from cavmarl.config.registry import load_config
from cavmarl.config.sensors import SensorsConfig
from cavmarl.evaluate.provenance.manifest import (
    MANIFEST_FILE,
    close_manifest,
    open_manifest,
    read_closed,
)
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE
from cavmarl.learning.actor_critic import ActorCritic, load_network, save_network
from cavmarl.learning.checkpoint import RunState, read_checkpoint, sealed, write_checkpoint
from cavmarl.networks.network_files import NetworkConfig
from fuzz.files import ROOT, Target, scratch, seed

__all__ = ["CHECKPOINTS", "DRIVERS", "ENTRIES", "MANIFESTS", "OVERRIDES", "PLANS"]

# Separator between the two files of a driver in an input.
_BORDER = b"\n----\n"

# Files beside the manifest.
RESULT, RESULT_CONTENT = "trips.csv", b"policy,run\n"


def _entry(content: bytes) -> EnvConfig:
    path = scratch("mine/env.yaml", content)
    validate(EnvConfig, read_yaml(path), str(path))
    return load_config(path.parent)[0]


def _entries() -> tuple[bytes, ...]:
    return tuple(path.read_bytes() for path in sorted((ROOT / "envs").glob("*/env.yaml")))


def _overrides(content: bytes) -> EnvConfig:
    settings = content.decode("utf-8", errors="replace").splitlines()
    return load_config("ring", overrides=parse_settings(settings))[0]


def _driver(content: bytes) -> object:
    config, _, weights = content.partition(_BORDER)
    folder = scratch(f"driver/{CONFIG_FILE}", config).parent
    scratch(f"driver/{WEIGHTS_FILE}", weights)
    return load_network(folder)


def _manifest(content: bytes) -> object:
    scratch(f"results/{RESULT}", RESULT_CONTENT)
    return read_closed(scratch(f"results/{MANIFEST_FILE}", content).parent)


def _manifests() -> tuple[bytes, ...]:
    found = []
    for results in ([], [RESULT]):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            (folder / RESULT).write_bytes(RESULT_CONTENT)
            open_manifest(folder, {"seed": 0})
            close_manifest(folder, results)
            found.append((folder / MANIFEST_FILE).read_bytes())
    return tuple(found)


def _plan(content: bytes) -> object:
    plan = read_plan(scratch("plan.json", content))
    return describe_plan(plan), replan(plan, plan.problem.snapshot).to_dict()


def _plans() -> tuple[bytes, ...]:
    first = make_plan(Problem(equal_costs(2, 2), ((1,), (0,)), idle_snapshot(2)))
    later = make_plan(replace(first.problem, present=(0, 0, 0, 1)))
    return tuple(json.dumps(plan.to_dict()).encode() for plan in (first, later))


@cache
def _drivers() -> tuple[bytes, ...]:
    found = []
    for kind in ("continuous", "discrete"):
        config = NetworkConfig(
            environment="ring",
            observation_size=3,
            sensors=SensorsConfig(),
            action=ActionConfig(kind=kind),
            hidden=(2,),
        )
        with tempfile.TemporaryDirectory() as name:
            save_network(Path(name), ActorCritic(config), config)
            parts = [(Path(name) / part).read_bytes() for part in (CONFIG_FILE, WEIGHTS_FILE)]
        found.append(_BORDER.join(parts))
    return tuple(found)


def _checkpoint(content: bytes) -> None:
    """Read a checkpoint whose damage the checksum does not reveal."""
    read_checkpoint(scratch(f"run/{CHECKPOINT_FILE}", sealed(content)).parent)


@cache
def _checkpoints() -> tuple[bytes, ...]:
    parts = {"weights": torch.zeros(2, 3), "trips": [1.0, 2.0], "next": None}
    state = RunState("ppo.py", {"seed": 0}, "ring", logs={"progress.csv": 9}, parts=parts)
    with tempfile.TemporaryDirectory() as name:
        write_checkpoint(Path(name), state)
        whole = (Path(name) / CHECKPOINT_FILE).read_bytes()
    return (whole[len(sealed(b"")) :],)


ENTRIES = Target(_entry, _entries)
OVERRIDES = Target(_overrides, lambda: (seed("overrides.txt"),))
MANIFESTS = Target(_manifest, _manifests)
PLANS = Target(_plan, _plans)
DRIVERS = Target(_driver, _drivers)
CHECKPOINTS = Target(_checkpoint, _checkpoints)
