"""The command line `cavmarl`. Each command is a file and imports what it needs when it runs."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any

import typer

from cavmarl.cli import (
    baseline,
    bench,
    board,
    carla,
    demand,
    demo,
    evacuate,
    evaluate,
    follow,
    journal,
    lead,
    listing,
    node,
    plan,
    replay,
    reproduce,
    ros2,
    scenario,
    service,
    submit_train,
    suite,
    train,
    verify,
    view,
    zoo,
)
from cavmarl.cli.output import (
    SERVICE,
    CliGroup,
    add_command,
    flag,
    print_error,
)
from cavmarl.config.removed_keys import removed_option
from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.core.tracebacks import print_traceback

__all__ = ["app", "main"]

# Groups of commands in the help.
START, TRAIN, MAPS = "Start here", "Train and evaluate", "Maps and demand"
DIVIDE, COSIM = "Divide worlds", "Co-simulation"


SUBMIT_TRAIN = "submit train"

REMOVED = {"verify-determinism": "verify determinism"}  # command → its replacement


class _Group(CliGroup):
    """The group of all commands.

    A removed command or option raises ConfigError with its replacement. `map` is imported on
    demand, as its imports take longer than all others.
    """

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except Exception as error:
            if refusal := removed_option(getattr(error, "option_name", None)):
                raise ConfigError(refusal) from error
            raise

    def list_commands(self, ctx: Any) -> list[str]:
        names = super().list_commands(ctx)
        names.insert(names.index("demand"), "map")
        return names

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return a command and its arguments; the name `submit train` is two words."""
        if args[:2] == SUBMIT_TRAIN.split():
            args = [SUBMIT_TRAIN, *args[2:]]
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        if cmd_name in REMOVED:
            raise ConfigError(f"{cmd_name} was removed: use cavmarl {REMOVED[cmd_name]}")
        if cmd_name != "map":
            return super().get_command(ctx, cmd_name)
        found = typer.main.get_group(import_module("cavmarl.cli.map").app)
        found.name = "map"
        vars(found)["rich_help_panel"] = MAPS
        return found


app = typer.Typer(
    cls=_Group,
    help="Multi-agent reinforcement learning for automated vehicles on real road networks.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_start, _train, _divide, _cosim, _service = (
    partial(add_command, app, panel=panel) for panel in (START, TRAIN, DIVIDE, COSIM, SERVICE)
)

_start("demo", demo.demo, "cavmarl demo", "cavmarl demo --decisions 500000")
_start("list", listing.list_entries, "cavmarl list")
_start(
    "view",
    view.view,
    "cavmarl view merge --web",
    "cavmarl view town --policy idm --video town.mp4 --seconds 60",
    "cavmarl view grid4x4 --agents 20 --zones 4 --backend processes:2 --web",
)
_start(
    "replay",
    replay.replay,
    "cavmarl replay runs/recording --web",
    "cavmarl replay runs/recording --episode 2 --mcap episode.mcap",
)
_train(
    "train",
    train.train,
    "cavmarl train",
    "cavmarl train ppo --config merge",
    ignore_unknown_options=True,
    allow_interspersed_args=False,
)
_train(
    SUBMIT_TRAIN,
    submit_train.submit_train,
    "cavmarl submit train ppo --config merge --to slurm --sbatch partition=long",
    "cavmarl submit train ppo --env town --to local --processes 2",
    "cavmarl submit train ppo --env ./mytown --to service --secret-file ada.secret",
    ignore_unknown_options=True,
)
_train(
    "evaluate",
    evaluate.evaluate,
    "cavmarl evaluate merge --policy idm --policy cities_ippo",
    "cavmarl evaluate grid4x4 --episodes 64 --repeats 3 --html report.html",
    "cavmarl evaluate merge --set sensors.lidar.rays=32 --json result.json",
)
_train("report", evaluate.report, "cavmarl report runs/evaluate/merge-1 --html report.html")
_train(
    "evacuate",
    evacuate.evacuate,
    "cavmarl evacuate city.osm.gz --vehicles 500 --out runs/city",
    "cavmarl evacuate plan.yaml --repeats 3",
)
_train("suite", suite.suite, "cavmarl suite standard --maps maps --policy cities_ippo")
_train("baseline", baseline.baseline, "cavmarl baseline city.net.xml --agents 8 --episodes 6")
_train("manifest", service.manifest, "cavmarl manifest runs/evaluate/merge-1")
app.add_typer(zoo.app, name="zoo", rich_help_panel=TRAIN)
app.add_typer(board.app, name="board", rich_help_panel=TRAIN)
app.add_typer(scenario.app, name="scenario", rich_help_panel=TRAIN)
app.add_typer(demand.app, name="demand", rich_help_panel=MAPS)
_divide(
    "plan",
    plan.plan,
    "cavmarl plan town --zones 9 --workers 3",
    "cavmarl plan town --snapshot idle --json plan.json",
)
_divide(
    "node",
    node.node,
    "cavmarl node --join 10.0.0.5:7000 --key-file node.key",
    "cavmarl node --service https://10.0.0.5:8700 --secret-file node.secret --slots 4",
    "mpirun -n 5 cavmarl node --mpi train.py",
    allow_interspersed_args=False,
)
_divide("journal", journal.journal, "cavmarl journal run.jsonl --at 1200")
_train(
    "reproduce",
    reproduce.reproduce,
    "cavmarl reproduce --quick",
    "cavmarl reproduce readme-speed",
    "cavmarl reproduce --all --file MAPS=maps --json found.json",
)
app.add_typer(verify.app, name="verify", rich_help_panel=DIVIDE)
app.add_typer(bench.app, name="bench", rich_help_panel=DIVIDE)
_cosim("lead", lead.lead, "cavmarl lead town --at 7100 --secret-file world.secret --followers 1")
_cosim(
    "follow",
    follow.follow,
    "cavmarl follow town --at 7100 --secret-file world.secret --vehicles car_0,car_1",
)
_cosim(
    "carla",
    carla.carla,
    "cavmarl carla grid4x4 --port 2000",
    "cavmarl carla town --agents 20 --client-version 0.10.0",
)
_cosim(
    "ros2",
    ros2.ros2,
    "cavmarl ros2 town --rig ten_sensors --truth",
    "cavmarl ros2 town --vehicle car_0 --vehicle car_1 --domain 5 --wait newest --pace 1",
    "cavmarl ros2 --join town.sock --vehicle car_0",
)
_service("serve", service.serve, "cavmarl serve --store runs/service.sqlite")
_service("grant", service.grant, "cavmarl grant alice --role client --secret-file admin.secret")
_service(
    "submit",
    service.submit,
    "cavmarl submit merge --policy idm --episodes 32 --secret-file alice.secret",
)
_service("nodes", service.nodes, "cavmarl nodes", "cavmarl nodes --drain node-1")
_service("sessions", service.sessions, "cavmarl sessions")
_service("artefacts", service.artefacts, "cavmarl artefacts")
_service("events", service.events, "cavmarl events --follow")


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cavmarl {version('cavmarl')}")
        raise typer.Exit


@app.callback()
def _exit_codes(
    _version: Annotated[
        bool, flag("Show the version.", "--version", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Exit codes: 0 success; 1 failed check; 2 wrong use; 130 interrupted; 143 terminated."""


def main(words: Sequence[str] | None = None) -> None:
    """Run a command.

    A CavmarlError is printed as one line, with exit code 2. For an exception in a user's code, the
    frames of that code are shown. On SIGTERM, as on an interrupt, a
    command ends, and closes and removes what it has created.
    """
    try:
        with _ended_by_sigterm():
            app(args=None if words is None else list(words), prog_name="cavmarl")
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
    """Raise SystemExit on SIGTERM, unless the calling program has its own handler."""
    held = signal.getsignal(signal.SIGTERM)
    if threading.current_thread() is not threading.main_thread() or held != signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, held)
