"""`cavmarl bench`: how fast it is, as ratios measured side by side in one run."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from cavmarl.cli.bench import step, traffic, train
from cavmarl.cli.report_command import report_command
from cavmarl.core.errors import ConfigError

# Commands and options that were removed, each with the benchmark that replaces it.
_MOVED = {"workers": "workers", "sensors": "sensors", "clock": "clock"}
_MOVED_OF_TRAFFIC = dict.fromkeys(
    ("--worlds", "--first-seed", "--out", "--without", "--maps"), "traffic_worlds"
)


def _refuse(word: str, name: str) -> None:
    raise ConfigError(
        f"cavmarl bench {word} was moved: run python -m benchmarks {name} in a checkout"
    )


class _Bench(TyperGroup):
    """Names the replacement of a command that was moved."""

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in _MOVED:
            _refuse(cmd_name, _MOVED[cmd_name])
        return super().get_command(ctx, cmd_name)


class _Traffic(TyperCommand):
    """Names the replacement of an option that was moved."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        for word in args:
            option = word.partition("=")[0]
            if option in _MOVED_OF_TRAFFIC:
                _refuse(f"traffic {option}", _MOVED_OF_TRAFFIC[option])
        return super().parse_args(ctx, args)


app = typer.Typer(cls=_Bench, help="How fast it is, measured side by side.", no_args_is_help=True)
app.command("step")(report_command(step.step))
app.command("traffic", cls=_Traffic)(report_command(traffic.traffic))
app.command("train")(report_command(train.train))
