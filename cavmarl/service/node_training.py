"""Training jobs on a node: the program `train/ppo.py` trains in a process of its own.

Meanwhile, the node stores the files of the run, with its last checkpoint, as the job's state with
the service. If the node is lost or drained, another node continues the run from there.
"""

from __future__ import annotations

import asyncio
import csv
import io
import sys
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from subprocess import DEVNULL, Popen
from typing import Any

from cavmarl.client.service_protocol import plain_name
from cavmarl.config.registry import programs
from cavmarl.core.errors import ServiceError, TrainingError
from cavmarl.core.processes import start_dying_with_process
from cavmarl.evaluate.provenance.training_record import CHECKPOINT_FILE, CSV_FILE, is_trained
from cavmarl.service.error_names import problem
from cavmarl.service.node_link import NodeLink, until_answered
from cavmarl.service.training_settings import PROGRAM, RUN, program_options

POLL_S = 0.5  # time between two looks at the program
STORE_S = 5.0  # shortest time between two states that the service stores
MOST_RUN_BYTES = 1 << 29  # maximum size of the files of a run
ROW_BYTES = 1 << 14  # maximum size of a row of a learning curve


async def train(
    link: NodeLink,
    job: dict[str, Any],
    document: dict[str, Any],
    work: Path,
    tell: Callable[[int, int], None],
) -> bool:
    """Train until the run is complete, from the state that the service has.

    Args:
        link: the connection to the service.
        job: the job, as in the answer to a heartbeat.
        document: its configuration.
        work: the working directory of the program, with the files of the configuration.
        tell: called with the decisions so far and their total.

    Returns:
        Whether the run is complete. If not, the node is being drained and the service has the
        state.

    Raises:
        TrainingError: the program has failed.
        ServiceError: the service refuses the state, or its state is damaged.
    """
    number, run = job["id"], work / RUN
    state, at = await until_answered(lambda: link.saved_state(number))
    if state is not None:
        unpack_run(state, run)
    if is_trained(run):
        return True
    run.parent.mkdir(exist_ok=True)
    messages = run.parent / "messages.txt"
    options = program_options(document, job["settings"], work)
    if (run / CHECKPOINT_FILE).exists():
        options = ["--resume", str(RUN)]
    command = [sys.executable, str(programs()[PROGRAM]), *options]
    with messages.open("wb") as file:
        program: Popen[bytes] = start_dying_with_process(
            command, cwd=work, stdin=DEVNULL, stdout=DEVNULL, stderr=file
        )
    stored, next_s, is_told = _stamp(run), time.monotonic() + STORE_S, False

    async def store() -> None:
        nonlocal stored, next_s, at
        stored, next_s, at = _stamp(run), time.monotonic() + STORE_S, at + 1
        content = await asyncio.to_thread(pack_run, run)
        await until_answered(lambda: link.save_state(number, at, content))

    try:
        while program.poll() is None:
            await asyncio.sleep(POLL_S)
            if total := int(job["settings"].get("total_agent_steps", 0)):
                tell(min(_decisions(run), total), total)
            if link.is_draining and not is_told:
                program.terminate()  # the program writes a checkpoint, and ends
                is_told = True
            if time.monotonic() > next_s and _stamp(run) != stored:
                await store()
    finally:
        if program.poll() is None:
            program.kill()
            program.wait()
    if is_trained(run):
        return True
    if not is_told:
        raise TrainingError(_message_of(messages) or f"exit code {program.returncode}")
    if _stamp(run) != stored:
        await store()
    return False


def run_files(run: Path) -> list[Path]:
    """Return the files of a run sorted by name, without lock files and temporary files."""
    return sorted(one for one in run.iterdir() if one.is_file() and not one.name.startswith("."))


def pack_run(run: Path) -> bytes:
    """Return the files of a run as one ZIP archive."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for file in run_files(run):
            archive.writestr(zipfile.ZipInfo(file.name), file.read_bytes(), zipfile.ZIP_DEFLATED)
    return content.getvalue()


def unpack_run(content: bytes, run: Path) -> None:
    """Write the files of a packed run into a new folder.

    Raises:
        ServiceError: the content is damaged, too large, or names another folder.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            files = archive.infolist()
            if (size := sum(one.file_size for one in files)) > MOST_RUN_BYTES:
                raise problem("damaged", f"the run has {size} bytes: at most {MOST_RUN_BYTES}")
            named = {plain_name(one.filename): archive.read(one) for one in files}
    except ServiceError:
        raise
    except Exception as error:  # zipfile raises errors of many types
        raise problem("damaged", f"the state of the run cannot be read: {error}") from error
    run.mkdir(parents=True)
    for name, file in named.items():
        (run / name).write_bytes(file)


def _stamp(run: Path) -> tuple[int, int]:
    """Return a value that changes with the checkpoint."""
    try:
        found = (run / CHECKPOINT_FILE).stat()
    except FileNotFoundError:
        return 0, 0
    return found.st_mtime_ns, found.st_ino


def _decisions(run: Path) -> int:
    """Return the number of decisions in the last complete row of the learning curve."""
    try:
        with (run / CSV_FILE).open("rb") as file:
            head = file.readline()
            size = file.seek(0, io.SEEK_END)
            file.seek(max(len(head), size - 2 * ROW_BYTES))  # the curve of a long run is large
            rows = [row for row in file.readlines() if row.endswith(b"\n")]
    except FileNotFoundError:
        return 0
    if not rows:
        return 0
    (row,) = csv.DictReader([head.decode(), rows[-1].decode()])
    return int(float(row["agent_steps"]))


def _message_of(messages: Path) -> str:
    """Return the last line of the program's error output."""
    lines = messages.read_text(encoding="utf-8", errors="replace").split("\n")
    return next((line.strip() for line in reversed(lines) if line.strip()), "")
