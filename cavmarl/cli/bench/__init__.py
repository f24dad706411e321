"""`cavmarl bench`: how fast it is, as ratios measured side by side in one run."""

from __future__ import annotations

import typer

from cavmarl.cli.bench.clock import clock
from cavmarl.cli.bench.sensors import sensors
from cavmarl.cli.bench.step import step
from cavmarl.cli.bench.traffic import traffic
from cavmarl.cli.bench.train import train
from cavmarl.cli.bench.workers import workers

__all__ = ["app"]

app = typer.Typer(help="How fast it is, measured side by side.", no_args_is_help=True)
for _command in (step, traffic, workers, sensors, clock, train):
    app.command()(_command)
