"""`cavmarl carla`: it listens until it is interrupted, and refuses wrong options."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys

import pytest

from cavmarl.cli import main

COMMAND = [sys.executable, "-m", "cavmarl", "carla", "grid4x4", "--agents", "2", "--port", "0"]


def test_the_server_listens_until_it_is_interrupted() -> None:
    # Background processes of a shell ignore SIGINT, and children inherit this.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    process = subprocess.Popen(COMMAND, stdout=subprocess.PIPE, text=True)
    signal.signal(signal.SIGINT, before)
    with process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.search(
                r"Carla/Maps/grid4x4 at 127\.0\.0\.1:(\d+), for client 0\.9\.16", line
            )
            assert found, line
            with socket.create_connection(("127.0.0.1", int(found[1])), 10.0):
                process.send_signal(signal.SIGINT)
                assert process.wait(30.0) == 130
        finally:
            process.kill()  # after a failed assertion, the process would not end


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--host", "0.0.0.0"], "no login; set any_host"),
        (["--client-version", "0.8"], "client version '0.8': must be one of 0.9.15"),
        (["--port", "70000"], "port = 70000: must be from 0 to 65534"),
        (["--max-clients", "0"], "max_clients = 0: must be at least 1"),
        (["--set", "action.kind=discrete"], "set action.kind = continuous"),
    ],
)
def test_wrong_options_are_refused(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["carla", "grid4x4", "--port", "0", *words])
    assert ended.value.code == 2
    assert message in " ".join(capsys.readouterr().err.split())
