"""`cavmarl verify`: whether a world gives the same bits however it is run."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperGroup

from cavmarl.cli.verify import determinism, nodes, workers, zones
from cavmarl.core.errors import ConfigError

__all__ = ["app"]


class _Checks(TyperGroup):
    """Refuses an environment or an option in the place of a check, and names the checks."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if args and args[0] not in (*self.commands, *ctx.help_option_names):
            raise ConfigError(
                f"verify {args[0]}: name what to check first: "
                f"cavmarl verify {'|'.join(self.commands)} …"
            )
        return super().parse_args(ctx, args)


app = typer.Typer(
    cls=_Checks,
    help="Check that a world gives the same bits however it is run; exit code 1 if it does not.",
    no_args_is_help=True,
)
app.command("zones")(zones.verify_zones)
app.command("nodes")(nodes.verify_nodes)
app.command("workers")(workers.verify_workers)
app.command("determinism")(determinism.verify_determinism)
