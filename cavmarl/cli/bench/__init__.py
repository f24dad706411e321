"""`cavmarl bench`: how fast it is, as ratios measured side by side in one run."""

from __future__ import annotations

import typer

from cavmarl.cli.bench import clock, sensors, step, traffic, train, workers

app = typer.Typer(help="How fast it is, measured side by side.", no_args_is_help=True)
for _command in (
    step.step, traffic.traffic, workers.workers, sensors.sensors, clock.clock, train.train,
):  # fmt: skip
    app.command()(_command)
