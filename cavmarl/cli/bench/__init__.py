"""`cavmarl bench`: speed relative to other simulators, measured side by side."""

from __future__ import annotations

from functools import partial

import typer

from cavmarl.cli.bench import signals, step, traffic, train
from cavmarl.cli.output import CliGroup, add_command
from cavmarl.cli.report_command import report_command

app = typer.Typer(
    cls=CliGroup, help="Measure speed side by side with other simulators.", no_args_is_help=True
)
_add = partial(add_command, app)

_add("step", report_command(step.step), "cavmarl bench step --agents 20 --repeats 3")
_add(
    "signals",
    report_command(signals.signals),
    "cavmarl bench signals grid4x4.sumocfg --worlds 1 --worlds 16",
)
_add(
    "traffic",
    report_command(traffic.traffic),
    "cavmarl bench traffic city.net.xml --demand city.rou.xml --seconds 900",
    "cavmarl bench traffic city.net.xml --demand city.rou.xml --speed",
)
_add("train", report_command(train.train), "cavmarl bench train --agents 20 --workers 2")
