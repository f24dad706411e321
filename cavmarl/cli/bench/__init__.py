"""`cavmarl bench`: speed relative to other simulators, measured side by side."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from cavmarl.cli.bench import signals, step, traffic, train
from cavmarl.cli.output import add_command
from cavmarl.cli.report_command import report_command
from cavmarl.core.errors import ConfigError

# Removed commands and options, with the benchmarks that replace them.
_MOVED = {"workers": "workers", "sensors": "sensors", "clock": "clock"}
_MOVED_OF_TRAFFIC = dict.fromkeys(
    ("--worlds", "--first-seed", "--out", "--without", "--maps"), "traffic_worlds"
)


def _refuse(word: str, name: str) -> None:
    raise ConfigError(
        f"cavmarl bench {word} was moved: run `python -m benchmarks {name}` in a checkout"
    )


class _Bench(TyperGroup):
    """A group that names the replacement of a command that was moved."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in _MOVED:
            _refuse(cmd_name, _MOVED[cmd_name])
        return super().get_command(ctx, cmd_name)


class _Traffic(TyperCommand):
    """A command that names the replacement of an option that was moved."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        for word in args:
            option = word.partition("=")[0]
            if option in _MOVED_OF_TRAFFIC:
                _refuse(f"traffic {option}", _MOVED_OF_TRAFFIC[option])
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_Bench, help="Measure speed side by side with other simulators.", no_args_is_help=True
)
add_command(
    app,
    "step",
    report_command(step.step),
    "cavmarl bench step --agents 20 --repeats 3",
)
add_command(
    app,
    "signals",
    report_command(signals.signals),
    "cavmarl bench signals grid4x4.sumocfg --worlds 1 --worlds 16",
)
add_command(
    app,
    "traffic",
    report_command(traffic.traffic),
    "cavmarl bench traffic city.net.xml --demand city.rou.xml --seconds 900",
    "cavmarl bench traffic city.net.xml --demand city.rou.xml --speed",
    cls=_Traffic,
)
add_command(
    app,
    "train",
    report_command(train.train),
    "cavmarl bench train --agents 20 --workers 2",
)
