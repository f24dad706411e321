"""Checkpoints: the driver, and what a run goes on from."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any, TypeVar

import torch

from cavmarl.config.io import validate
from cavmarl.core.errors import ConfigError, PolicyError
from cavmarl.policies.networks import ActorCritic, NetworkConfig, load_network, save_network

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

OPTIMIZER_FILE = "optimizer.pt"
STATE_FILE = "training.json"

S = TypeVar("S", bound="DataclassInstance")


@dataclass(frozen=True)
class RunState:
    """How far a run has come."""

    args: dict[str, Any]  # its settings, by name
    agent_steps: int = 0  # decisions that it learned from
    updates: int = 0  # of the network
    seconds: float = 0.0  # spent on them

    def settings(self, kind: type[S]) -> S:
        return validate(kind, self.args, STATE_FILE)


def read_state(folder: Path) -> RunState:
    path = folder / STATE_FILE
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"--resume {folder}: no checkpoint there ({error.strerror})") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is broken ({error})") from error
    return validate(RunState, raw, str(path))


def save_checkpoint(
    folder: Path,
    network: ActorCritic,
    optimizer: torch.optim.Optimizer,
    config: NetworkConfig,
    state: RunState,
) -> None:
    """The driver, and what goes on from here; an interrupted write leaves the old files whole."""
    save_network(folder, network, replace(config, agent_steps=state.agent_steps))
    path = folder / f".{OPTIMIZER_FILE}"
    torch.save(optimizer.state_dict(), path)
    os.replace(path, folder / OPTIMIZER_FILE)
    noted = folder / f".{STATE_FILE}"
    noted.write_text(json.dumps(asdict(state), indent=2) + "\n", encoding="utf-8")
    os.replace(noted, folder / STATE_FILE)


def load_checkpoint(
    folder: Path, network: ActorCritic, optimizer: torch.optim.Optimizer, config: NetworkConfig
) -> None:
    """Put a run's weights and its optimiser's state into others."""
    loaded, saved = load_network(folder)
    if replace(saved, agent_steps=0) != config:
        raise PolicyError(
            f"--resume {folder}: the environment's sensors or actions have changed since that run"
        )
    network.load_state_dict(loaded.state_dict())
    path = folder / OPTIMIZER_FILE
    try:
        optimizer.load_state_dict(torch.load(path, weights_only=True))
    except (OSError, RuntimeError, ValueError, EOFError, KeyError, UnpicklingError) as error:
        raise PolicyError(f"{path}: cannot be read ({error})") from error
