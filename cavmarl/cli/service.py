"""`cavmarl serve` and what is asked of a service: nodes, sessions, events, jobs."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from cavmarl.cli.output import (
    JsonPath,
    about,
    grid,
    make_folder,
    pairs_grid,
    with_world,
    write_json,
)
from cavmarl.config.world_spec import WorldSpec
from cavmarl.core.errors import ServiceError, require
from cavmarl.core.progress import progress_bar

if TYPE_CHECKING:
    from cavmarl.client import Client

URL_VARIABLE = "CAVMARL_SERVICE"
SECRET_VARIABLE = "CAVMARL_SECRET"
DEFAULT_URL = "http://127.0.0.1:8700"

Url = Annotated[str, about("URL of the service.", "--service", envvar=URL_VARIABLE)]
SecretFile = Annotated[
    Path | None,
    about(f"File with a secret; default: ${SECRET_VARIABLE}.", "--secret-file"),
]
Authority = Annotated[
    Path | None, about("Certificate of the authority that has signed the service's.")
]
Certificate = Annotated[Path | None, about("Certificate for TLS, PEM.")]
Key = Annotated[Path | None, about("Its private key, PEM.")]


def serve(
    host: Annotated[str, about("Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, about("Port; 0: any.", min=0, max=65535)] = 8700,
    store: Annotated[str, about("File of SQLite, or postgresql://…")] = "runs/service.sqlite",
    certificate: Certificate = None,
    key: Key = None,
    beat_s: Annotated[float, about("Seconds from beat to beat of nodes.", min=0.05)] = 1.0,
    missed_beats: Annotated[int, about("After so many a node is down.", min=1)] = 3,
    lease_s: Annotated[float, about("Seconds of a session's lease.", min=1.0)] = 30.0,
) -> None:
    """Coordinate nodes and sessions; at the first start the admin's secret is shown, once."""
    require("fastapi", "service")
    from cavmarl.service.broker import BrokerRules
    from cavmarl.service.server import ServerOptions
    from cavmarl.service.server import serve as run

    rules = BrokerRules(beat_s=beat_s, missed_beats=missed_beats, lease_s=lease_s)
    options = ServerOptions(host, port, store, certificate, key, rules=rules)
    run(options, _tell)


def grant(
    name: Annotated[str, typer.Argument(help="Name of a person, a program or a node.")],
    role: Annotated[str, about("viewer, client, operator, admin or node.")] = "client",
    service: Url = DEFAULT_URL,
    secret_file: SecretFile = None,
    authority: Authority = None,
) -> None:
    """Make an identity, and print its secret: it is shown this once."""
    with connect(service, secret_file, authority) as client:
        _tell(client.post("/identities", {"name": name, "role": role})["secret"])


@with_world()
def submit(
    world: WorldSpec,
    policy: Annotated[
        list[str] | None, about("A name of `cavmarl list`; may be repeated.", "--policy", "-p")
    ] = None,
    episodes: Annotated[int, about("Episodes of each run.", "--episodes", "-n")] = 32,
    repeats: Annotated[int, about("Independent runs.", "--repeats", "-r")] = 1,
    wait_s: Annotated[
        float | None, about("Fail if no node has taken it after so many seconds.", min=0.0)
    ] = None,
    out: Annotated[Path | None, about("Folder of the results; default: runs/submit/JOB.")] = None,
    service: Url = DEFAULT_URL,
    secret_file: SecretFile = None,
    authority: Authority = None,
    json_path: JsonPath = None,
) -> None:
    """Have a node of the service evaluate drivers; wait, fetch the results and show them."""
    from cavmarl.cli.evaluate import report_table
    from cavmarl.evaluate import load_report

    console = Console()
    keys = {**world.keywords, "seed": world.seed, "overrides": dict(world.overrides)}
    del keys["max_cycles"]
    with connect(service, secret_file, authority) as client:
        job = client.submit(
            world.env, policies=policy or ["idm"], episodes=episodes, repeats=repeats,
            wait_s=wait_s, **keys,
        )  # fmt: skip
        folder = out or Path("runs/submit") / job
        make_folder(folder)
        with progress_bar(console) as bar:
            task = bar.add_task(job)

            def show(found: dict[str, Any]) -> None:
                done, total = found["progress"] or (0, None)
                what = f"{job}: {found['state']}"
                bar.update(task, description=what, completed=done, total=total)

            client.wait(job, folder, told=show)
        told = "".join(json.dumps(event) + "\n" for event in client.events(job))
        (folder / "service_events.jsonl").write_text(told, encoding="utf-8")
    found = load_report(folder)
    console.print(report_table(found))
    write_json(json_path, found.to_dict())
    _tell(f"job: {job}\nresults: {folder} (`cavmarl report` shows them again)")


def nodes(
    service: Url = DEFAULT_URL,
    secret_file: SecretFile = None,
    authority: Authority = None,
    drain: Annotated[str | None, about("Drain this node first.", metavar="NAME")] = None,
    resume: Annotated[
        str | None, about("Let this node take sessions again.", metavar="NAME")
    ] = None,
    json_path: JsonPath = None,
) -> None:
    """Show the nodes of a service: state, load, LoadScore, sessions."""
    with connect(service, secret_file, authority) as client:
        for name, word in ((drain, "drain"), (resume, "resume")):
            if name is not None:
                client.post(f"/nodes/{name}/{word}")
        found = client.get("/nodes")
    rows = [
        (one["name"], f"{one['address']}:{one['client_port']}", _state(one),
         *(_share((one["load"] or {}).get(name)) for name in ("cpu", "ram", "gpu")),
         _share(one["score"]), f"{one['sessions']}/{one['slots']}", f"{one['age_s']:.1f}")
        for one in found["nodes"]
    ]  # fmt: skip
    heads = ("node", "address", "state", "cpu", "ram", "gpu", "score", "sessions", "heard, s ago")
    Console().print(grid(heads, rows, lefts=3))
    write_json(json_path, found)


def sessions(
    page: Annotated[
        str | None,
        about("Have its node serve a page of this session, to watch and control it."),
    ] = None,
    service: Url = DEFAULT_URL,
    secret_file: SecretFile = None,
    authority: Authority = None,
    json_path: JsonPath = None,
) -> None:
    """Show sessions and jobs: your own, or all; or the worlds of one, in a browser."""
    with connect(service, secret_file, authority) as client:
        if page is not None:
            told = client.take_up(page).page()
            _tell(f"viewer: {told['address']}")
            _tell(f"token: {told['token']}")
            _tell(f"token to watch only: {told['watch_token']}")
            write_json(json_path, told)
            return
        found = client.get("/sessions")
    rows = [
        (one["id"], one["owner_name"], "world" if one["job"] is None else "job",
         one["state"], one["node"] or "-", str(one["placements"]))
        for one in found["sessions"]
    ]  # fmt: skip
    Console().print(grid(("session", "owner", "kind", "state", "node", "placed"), rows, lefts=5))
    write_json(json_path, found)


def events(
    after: Annotated[int, about("Those after this number.", min=0)] = 0,
    follow: Annotated[bool, about("Go on as they come.", "--follow", "-f")] = False,
    subject: Annotated[
        str | None, about("Only those of this session, job, node or configuration.")
    ] = None,
    service: Url = DEFAULT_URL,
    secret_file: SecretFile = None,
    authority: Authority = None,
) -> None:
    """Print the log of a service, one event a line, as JSON."""
    with connect(service, secret_file, authority) as client:
        if follow:
            for event in client.follow(after):
                if subject in (None, event["subject"]):
                    _tell(json.dumps(event))
            return
        params = {"limit": 1000} | ({} if subject is None else {"subject": subject})
        while lines := client.get("/events", after=after, **params)["events"]:
            for event in lines:
                _tell(json.dumps(event))
            after = lines[-1]["sequence"]


def manifest(
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="A manifest.json, or its folder.", exists=True)
    ],
    json_path: JsonPath = None,
) -> None:
    """Show what results were made with; exit code 2 if a file beside it is not as it was."""
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
        "files": f"{len(document['results_sha256'])}, each with the hash on record",
    }
    Console().print(pairs_grid((name, str(value)) for name, value in shown.items()))
    write_json(json_path, document)


def connect(service: str, secret_file: Path | None, authority: Path | None) -> Client:
    """A client with the secret of the caller."""
    require("httpx", "service")
    from cavmarl.client import Client

    verify = str(authority) if authority else True
    return Client(service, read_secret(secret_file), verify=verify)


def read_secret(secret_file: Path | None) -> str:
    """The secret in a file, or in the environment: not on the command line, which all can read."""
    if secret_file is not None:
        try:
            return secret_file.read_text(encoding="utf-8").strip()
        except OSError as error:
            raise ServiceError(f"{secret_file}: cannot be read ({error.strerror})") from error
    secret = os.environ.get(SECRET_VARIABLE, "")
    if not secret:
        raise ServiceError(
            f"no secret: give --secret-file, or set {SECRET_VARIABLE}; `cavmarl serve` shows the "
            "admin's, `cavmarl grant NAME` makes others"
        )
    return secret


def _state(node: dict[str, Any]) -> str:
    words = [node["state"], *(["draining"] if node["draining"] else []), *node["excluded"]]
    return " ".join(words)


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _tell(line: str) -> None:
    typer.echo(line)
