"""The command line, `cavmarl`: one small file a command; each loads what it needs when it runs."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from cavmarl.cli import (
    baseline,
    bench,
    demand,
    demo,
    evaluate,
    follow,
    journal,
    lead,
    listing,
    node,
    plan,
    replay,
    scenario,
    service,
    suite,
    train,
    verify,
    view,
    zoo,
)
from cavmarl.cli.output import about, print_error
from cavmarl.config.removed_keys import removed_option
from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.core.tracebacks import print_traceback

__all__ = ["app", "main"]


REMOVED = {"verify-determinism": "verify determinism"}  # command → what replaces it


class _Group(TyperGroup):
    """The commands; those that were removed are refused, with what replaces them.

    `map` is loaded when it is asked for: its imports take longer than the rest.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run a command; of an option that was removed, say what replaced it."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            if refusal := removed_option(getattr(error, "option_name", None)):
                raise ConfigError(refusal) from error
            raise

    def list_commands(self, ctx: Any) -> list[str]:
        return [*super().list_commands(ctx), "map"]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in REMOVED:
            raise ConfigError(f"{cmd_name} is no command: use cavmarl {REMOVED[cmd_name]}")
        if cmd_name != "map":
            return super().get_command(ctx, cmd_name)
        found = typer.main.get_group(import_module("cavmarl.cli.map").app)
        found.name = "map"
        return found


app = typer.Typer(
    cls=_Group,
    help="Multi-agent reinforcement learning for automated vehicles on real road networks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(evaluate.evaluate)
app.command()(evaluate.report)
app.command()(suite.suite)
app.command()(baseline.baseline)
app.command()(journal.journal)
app.command()(plan.plan)
app.command()(lead.lead)
app.command()(follow.follow)
app.command(context_settings={"allow_interspersed_args": False})(node.node)
app.command()(view.view)
app.command()(replay.replay)
app.command()(demo.demo)
app.command(context_settings={"ignore_unknown_options": True, "allow_interspersed_args": False})(
    train.train
)
app.command()(service.serve)
app.command()(service.grant)
app.command()(service.submit)
app.command()(service.nodes)
app.command()(service.sessions)
app.command()(service.events)
app.command()(service.manifest)
app.command("list")(listing.list_entries)
app.add_typer(demand.app, name="demand")
app.add_typer(bench.app, name="bench")
app.add_typer(scenario.app, name="scenario")
app.add_typer(verify.app, name="verify")
app.add_typer(zoo.app, name="zoo")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cavmarl {version('cavmarl')}")
        raise typer.Exit


@app.callback()
def _exit_codes(
    _version: Annotated[
        bool, about("Show the version.", "--version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Exit codes: 0 success; 1 failed check; 2 wrong use; 130 interrupted; 143 terminated."""


def main(words: Sequence[str] | None = None) -> None:
    """Run a command; an error that cavmarl raises on purpose is one line and exit code 2.

    Of an exception in the code of a user, the frames of that code are shown. SIGTERM ends a
    command as an interrupt does: what it has begun is closed and removed.
    """
    try:
        with _ended_by_sigterm():
            app(args=None if words is None else list(words))
    except CavmarlError as error:
        print_error(str(error))
        sys.exit(2)
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        print_traceback(error)
        sys.exit(1)


@contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """SIGTERM raises SystemExit here, unless the program that calls has a handler of its own."""
    held = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or held != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, held)
