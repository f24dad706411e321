"""`cavmarl verify`: checks that results do not depend on how a world is run."""

from __future__ import annotations

from functools import partial
from typing import Any

import typer

from cavmarl.cli.output import CliGroup, add_command
from cavmarl.cli.verify import determinism, nodes, recordings, workers, zones
from cavmarl.core.errors import ConfigError

__all__ = ["app"]


class _Checks(CliGroup):
    """A group that names the checks if an environment or an option is given in their place."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            raise ConfigError(
                f"verify {args[0]}: the name of a check must come first: "
                f"cavmarl verify {'|'.join(self.commands)} …"
            )
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_Checks,
    help="Check bit for bit that results do not depend on how a world is run.",
    no_args_is_help=True,
)
_add = partial(add_command, app)
_add("zones", zones.verify_zones, "cavmarl verify zones town --zones 1,4,9 --steps 200")
_add(
    "nodes",
    nodes.verify_nodes,
    "cavmarl verify nodes grid4x4 --nodes 2,4 --kill 1",
    "cavmarl verify nodes --faults simulated --seeds 5",
)
_add(
    "workers",
    workers.verify_workers,
    "cavmarl verify workers merge --kill 10 --backend processes:2",
)
_add("determinism", determinism.verify_determinism, "cavmarl verify determinism town --steps 300")
_add(
    "recording",
    recordings.verify_recording,
    "cavmarl verify recording town --recording run --set population.external=4",
)
