"""`cavmarl serve` and the commands for its users: grant, submit, nodes, sessions, events."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape

from cavmarl.balance.load_score import THRESHOLDS, WEIGHTS, LoadRule
from cavmarl.cli.output import (
    OUTPUT,
    SERVICE,
    Episodes,
    JsonPath,
    Repeats,
    about,
    flag,
    grid,
    make_folder,
    pairs_grid,
    with_world,
    write_json,
)
from cavmarl.config.registry import agent_entries, entries
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ConfigError, ServiceError, require
from cavmarl.core.private_files import read_private, write_private
from cavmarl.core.progress import progress_bar

if TYPE_CHECKING:
    from rich.progress import Progress

    from cavmarl.client import Client

URL_VARIABLE = "CAVMARL_SERVICE"
SECRET_VARIABLE = "CAVMARL_SECRET"
DEFAULT_URL = "http://127.0.0.1:8700"

Url = Annotated[
    str,
    about(
        "URL of the service; URLs of its standbys may follow, comma-separated.",
        "--service",
        metavar="URL",
        envvar=URL_VARIABLE,
        panel=SERVICE,
    ),
]
UserSecretFile = Annotated[
    Path | None,
    about(
        f"File with your secret [default: the variable {SECRET_VARIABLE}].",
        "--secret-file",
        metavar="FILE",
        panel=SERVICE,
    ),
]
Authority = Annotated[
    Path | None,
    about(
        "Certificate (PEM) of the authority that signed the service's certificate.",
        metavar="FILE",
        panel=SERVICE,
    ),
]
PlainHttp = Annotated[
    bool,
    flag(
        "Send secrets to other machines even without TLS; only for networks that you trust.",
        "--plain-http",
        panel=SERVICE,
    ),
]
Certificate = Annotated[
    Path | None, about("Certificate for TLS (PEM).", metavar="FILE", panel=SERVICE)
]
Key = Annotated[
    Path | None, about("Private key of the certificate (PEM).", metavar="FILE", panel=SERVICE)
]


def _joined(shares: tuple[float, ...]) -> str:
    return ",".join(map(str, shares))


def _shares(option: str, text: str) -> tuple[float, float, float]:
    """Return three shares; raise ConfigError if the text is not three numbers."""
    try:
        cpu, ram, gpu = (float(word) for word in text.split(","))
    except ValueError:
        raise ConfigError(
            f"{option} {text}: must be three numbers, of CPU, RAM and GPU, for example "
            "0.85,0.9,0.95"
        ) from None
    return cpu, ram, gpu


def serve(
    host: Annotated[str, about("Address to listen on.", metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[
        int, about("Port to listen on; 0 picks a free port.", metavar="PORT", min=0, max=65535)
    ] = 8700,
    store: Annotated[
        str,
        about("Event store: an SQLite file, or the URL of a PostgreSQL database.", metavar="STORE"),
    ] = "runs/service.sqlite",
    certificate: Certificate = None,
    key: Key = None,
    beat_s: Annotated[
        float, about("Seconds between heartbeats of a node.", metavar="S", min=0.05)
    ] = 1.0,
    missed_beats: Annotated[
        int, about("Number of missed heartbeats after which a node is down.", metavar="N", min=1)
    ] = 3,
    lease_s: Annotated[
        float, about("Duration of a session's lease in seconds.", metavar="S", min=1.0)
    ] = 30.0,
    thresholds: Annotated[
        str,
        about(
            "Shares of CPU, RAM and GPU above which a node gets no sessions.", metavar="CPU,RAM,GPU"
        ),
    ] = _joined(THRESHOLDS),
    weights: Annotated[
        str, about("Weights of CPU, RAM and GPU in the LoadScore.", metavar="CPU,RAM,GPU")
    ] = _joined(WEIGHTS),
    artefact_mb: Annotated[
        float, about("Megabytes of files that one user may store.", metavar="MB", min=0.0)
    ] = 1024.0,
    artefact_days: Annotated[
        float,
        about("Days after which an unused file is deleted.", metavar="DAYS", min=0.0),
    ] = 30.0,
    snapshot_events: Annotated[
        int,
        about(
            "Number of events between two snapshots. A start replays only the events after the "
            "last snapshot. 0: delete the snapshot, write none, and always replay all events.",
            metavar="N",
            min=0,
        ),
    ] = 10_000,
    standby: Annotated[
        bool,
        flag(
            "Follow the store of another service, and take over when it ends; needs PostgreSQL.",
            "--standby",
        ),
    ] = False,
) -> None:
    """Run the coordination service.

    The first start prints the secret of the admin. It is not shown again.
    """
    require("fastapi", "service")
    from cavmarl.service.artefacts import Quota
    from cavmarl.service.broker import BrokerRules
    from cavmarl.service.server import ServerOptions
    from cavmarl.service.server import serve as run

    load = LoadRule(_shares("--weights", weights), _shares("--thresholds", thresholds))
    quota = Quota(total_bytes=int(artefact_mb * 1e6), days=artefact_days)
    rules = BrokerRules(
        beat_s=beat_s, missed_beats=missed_beats, lease_s=lease_s, load=load, artefacts=quota
    )
    options = ServerOptions(
        host, port, store, certificate, key,
        rules=rules, is_standby=standby, snapshot_events=snapshot_events,
    )  # fmt: skip
    run(options, _print)


def grant(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Name of the person, program or node.")
    ],
    role: Annotated[
        str, about("Role: viewer, client, operator, admin or node.", metavar="ROLE")
    ] = "client",
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
    out: Annotated[
        Path | None,
        about(
            "New file for the secret, which only you can read [default: print it].",
            metavar="FILE",
            panel=OUTPUT,
        ),
    ] = None,
) -> None:
    """Create an identity and its secret, which is not shown again."""
    with connect(service, secret_file, authority, plain_http) as client:
        if out is not None:
            # The secret is shown only once: if the file cannot be written, create no identity.
            _write_secret(out, "")
        secret = client.post("/identities", {"name": name, "role": role})["secret"]
    if out is None:
        _print(secret)
    else:
        out.write_text(f"{secret}\n", encoding="utf-8")


@with_world(is_here=False)
def submit(
    world: WorldSpec,
    env: Annotated[
        str,
        typer.Argument(
            metavar="ENV",
            help="Environment: a name that the service and its nodes know, or the path of your "
            "own folder or map, which is uploaded once.",
        ),
    ],
    policy: Annotated[
        list[str] | None,
        about(
            "Driver to evaluate: a name that the service and its nodes know, or the folder of "
            "your own trained driver, which is uploaded once. Repeat the option to compare other "
            "drivers with the first driver [default: idm].",
            "--policy",
            "-p",
            metavar="POLICY",
        ),
    ] = None,
    episodes: Episodes = 32,
    repeats: Repeats = 1,
    wait_s: Annotated[
        float | None,
        about("Fail if no node has started the job after S seconds.", metavar="S", min=0.0),
    ] = None,
    spread: Annotated[
        bool,
        flag(
            "Submit each run as a separate job, so that several nodes share the work, and merge "
            "the results."
        ),
    ] = False,
    out: Annotated[
        Path | None,
        about("Folder for the results [default: runs/submit/JOB].", metavar="DIR", panel=OUTPUT),
    ] = None,
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
    json_path: JsonPath = None,
) -> None:
    """Evaluate drivers on the nodes of the service, and show the results."""
    from cavmarl.cli.evaluate import report_table
    from cavmarl.evaluate import load_report
    from cavmarl.evaluate.evaluation import run_seeds
    from cavmarl.evaluate.merging import merge_runs

    console = Console()
    keys = {**world.keywords, "overrides": dict(world.overrides)}
    del keys["max_cycles"]
    environment, names, keys["drivers"] = uploads(world.env, policy or ["idm"])
    seeds = run_seeds(world.seed, repeats) if spread else [world.seed]
    with connect(service, secret_file, authority, plain_http) as client:
        jobs = [
            client.submit(
                environment, policies=names, episodes=episodes,
                repeats=1 if spread else repeats, wait_s=wait_s, seed=seed, **keys,
            )
            for seed in seeds
        ]  # fmt: skip
        folder = out or Path("runs/submit") / jobs[0]
        parts = [folder / "runs" / str(run) for run in range(repeats)] if spread else [folder]
        try:
            with progress_bar(console) as bar:
                for job, part in zip(jobs, parts, strict=True):
                    _collect(client, job, part, bar)
        except BaseException:
            for job in jobs:
                with suppress(ServiceError):  # the job has ended
                    client.delete(f"/sessions/{job}")
            raise
    if spread:
        merge_runs(parts, folder)
    found = load_report(folder)
    console.print(report_table(found))
    write_json(json_path, found.to_dict())
    _print(f"job: {', '.join(jobs)}\nresults: {folder} (`cavmarl report` shows them again)")


def uploads(env: str, policies: list[str]) -> tuple[str | Path, list[str], dict[str, Path]]:
    """Return the environment, the names of the drivers, and the folders of drivers to upload."""
    environment: str | Path = env
    if env not in entries() and Path(env).exists():
        environment = Path(env)
    drivers = {
        Path(policy).resolve().name: Path(policy)
        for policy in policies
        if policy not in agent_entries() and Path(policy).is_dir()
    }
    names = [Path(one).resolve().name if Path(one) in drivers.values() else one for one in policies]
    if len(set(names)) < len(set(policies)):
        raise ConfigError(f"--policy {' '.join(policies)}: equal names; rename a folder")
    return environment, names, drivers


def artefacts(
    delete: Annotated[
        str | None, about("Delete the file with this SHA-256.", metavar="SHA256")
    ] = None,
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
    json_path: JsonPath = None,
) -> None:
    """Show the files that you have uploaded to the service, or delete one."""
    with connect(service, secret_file, authority, plain_http) as client:
        if delete is not None:
            client.delete(f"/artefacts/{delete}")
        found = client.get("/artefacts")
    rows = [
        (one["sha256"][:12], escape(one["name"]), escape(one["licence"]) or "-",
         f"{one['size_bytes'] / 1e6:.2f}", f"{(one['until_s'] - time.time()) / 86_400.0:.1f}")
        for one in found["artefacts"]
    ]  # fmt: skip
    Console().print(grid(("sha256", "name", "licence", "MB", "days left"), rows, lefts=3))
    write_json(json_path, found)


def _collect(client: Client, job: str, folder: Path, bar: Progress) -> dict[str, Any]:
    """Wait for a job while showing its progress, and write its results and events to a folder.

    Return the job.
    """
    make_folder(folder)
    task = bar.add_task(job)
    told_reasons = {""}

    def show(found: dict[str, Any]) -> None:
        if found["waits_for"] not in told_reasons:
            told_reasons.add(found["waits_for"])
            bar.console.print(f"{job} waits: {found['waits_for']}", markup=False)
        done, total = found["progress"] or (0, None)
        bar.update(task, description=f"{job}: {found['state']}", completed=done, total=total)

    ended = client.wait(job, folder, inf, told=show)
    told = "".join(json.dumps(event) + "\n" for event in client.events(job))
    (folder / "service_events.jsonl").write_text(told, encoding="utf-8")
    return ended


def nodes(
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
    drain: Annotated[
        str | None, about("Drain this node: it accepts no new sessions.", metavar="NODE")
    ] = None,
    resume: Annotated[
        str | None, about("Let this node accept sessions again.", metavar="NODE")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Show the nodes of a service with state, load, LoadScore and sessions."""
    with connect(service, secret_file, authority, plain_http) as client:
        for name, word in ((drain, "drain"), (resume, "resume")):
            if name is not None:
                client.post(f"/nodes/{name}/{word}")
        found = client.get("/nodes")
    rows = [
        (escape(one["name"]), f"{one['address']}:{one['client_port']}", _state(one),
         *(_share((one["load"] or {}).get(name)) for name in ("cpu", "ram", "gpu")),
         _share(one["score"]), f"{one['sessions']}/{one['slots']}", f"{one['age_s']:.1f}")
        for one in found["nodes"]
    ]  # fmt: skip
    heads = ("node", "address", "state", "cpu", "ram", "gpu", "score", "used", "age, s")
    Console().print(grid(heads, rows, lefts=3))
    _print_reasons((one["name"], reason) for one in found["nodes"] for reason in one["limits"])
    write_json(json_path, found)


def sessions(
    page: Annotated[
        str | None,
        about(
            "Open a page for this session on its node, and print the page's address and tokens.",
            metavar="SESSION",
        ),
    ] = None,
    collect: Annotated[
        str | None,
        about("Wait for the end of this job, and write its results to --out.", metavar="JOB"),
    ] = None,
    out: Annotated[
        Path | None,
        about("Folder for the results [default: runs/submit/JOB].", metavar="DIR", panel=OUTPUT),
    ] = None,
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
    json_path: JsonPath = None,
) -> None:
    """Show your sessions and jobs, open the page of a session, or fetch the results of a job."""
    if out is not None and collect is None:
        raise ConfigError("--out: is for the results of a job; add --collect JOB")
    with connect(service, secret_file, authority, plain_http) as client:
        if page is not None:
            told = client.take_up(page).page()
            _print(f"viewer: {told['address']}")
            _print(f"token: {told['token']}")
            _print(f"token to watch only: {told['watch_token']}")
            write_json(json_path, told)
            return
        if collect is not None:
            folder, console = out or Path("runs/submit") / collect, Console()
            with progress_bar(console) as bar:
                write_json(json_path, _collect(client, collect, folder, bar))
            _print(f"results: {folder}")
            return
        found = client.get("/sessions")
    rows = [
        (one["id"], one["owner_name"], "world" if one["job"] is None else "job",
         one["state"], one["node"] or "-", str(one["placements"]))
        for one in found["sessions"]
    ]  # fmt: skip
    Console().print(grid(("session", "owner", "kind", "state", "node", "placed"), rows, lefts=5))
    waiting = [(one["id"], one["waits_for"]) for one in found["sessions"] if one["waits_for"]]
    _print_reasons(waiting)
    write_json(json_path, found)


def events(
    after: Annotated[int, about("Print only events after this number.", metavar="N", min=0)] = 0,
    follow: Annotated[bool, flag("Keep printing new events.", "--follow", "-f")] = False,
    subject: Annotated[
        str | None,
        about("Print only events of this session, job, node or configuration.", metavar="NAME"),
    ] = None,
    service: Url = DEFAULT_URL,
    secret_file: UserSecretFile = None,
    authority: Authority = None,
    plain_http: PlainHttp = False,
) -> None:
    """Print the event log of a service as JSON, one event per line."""
    with connect(service, secret_file, authority, plain_http) as client:
        if follow:
            for event in client.follow(after):
                if subject in (None, event["subject"]):
                    _print(json.dumps(event))
            return
        params = {"limit": 1000} | ({} if subject is None else {"subject": subject})
        while lines := client.get("/events", after=after, **params)["events"]:
            for event in lines:
                _print(json.dumps(event))
            after = lines[-1]["sequence"]


def manifest(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A manifest.json file, or its folder.", exists=True),
    ],
    json_path: JsonPath = None,
) -> None:
    """Show how results were made, and check their files.

    If a file differs from its recorded hash, exit with 2.
    """
    from cavmarl.evaluate.provenance.manifest import read_closed

    document = read_closed(file if file.is_dir() else file.parent)
    world = document.get("world", {})
    shown = {
        "command": " ".join(document["command"]),
        "world": f"{world.get('environment')}, map {world.get('map')}",
        "configuration": world.get("config_sha256"),
        "policies": ", ".join(document.get("policies", ())),
        "seeds": ", ".join(map(str, document.get("seeds", ()))),
        "time": f"{document['started']} to {document['ended']}",
        "files": f"{len(document['results_sha256'])}, each with the recorded hash",
    }
    Console().print(pairs_grid((name, str(value)) for name, value in shown.items()))
    write_json(json_path, document)


def connect(
    service: str, secret_file: Path | None, authority: Path | None, plain_http: bool = False
) -> Client:
    """Return a client that is authenticated with the user's secret."""
    require("httpx", "service")
    from cavmarl.client import Client

    verify = str(authority) if authority else True
    secret = user_secret(secret_file)
    return Client(service, secret, verify=verify, allow_plain_http=plain_http)


def user_secret(secret_file: Path | None) -> str:
    """Return the secret from a file or an environment variable.

    No option takes the secret itself, as other users can read the command line.
    """
    if secret_file is not None:
        return read_private("--secret-file", secret_file)
    secret = os.environ.get(SECRET_VARIABLE, "")
    if not secret:
        raise ServiceError(
            f"the secret is missing: give --secret-file or set {SECRET_VARIABLE}; `cavmarl serve` "
            "prints the secret of the admin, `cavmarl grant NAME` creates others"
        )
    return secret


def _write_secret(path: Path, text: str) -> None:
    try:
        write_private(path, text)
    except OSError as error:
        raise ServiceError(f"--out {path}: {error.strerror}; give a new file") from error


def _state(node: dict[str, Any]) -> str:
    return "draining" if node["draining"] else str(node["state"])


def _print_reasons(rows: Iterable[tuple[str, str]]) -> None:
    """Print the reasons why nodes accept no sessions, or why jobs wait, below a table."""
    for name, reason in rows:
        Console().print(f"{name}: {reason}", markup=False, highlight=False)


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _print(line: str) -> None:
    typer.echo(line)
