"""Parse the argument `backend` and the arguments that stand for it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import cavmarl
from cavmarl.core.errors import ConfigError
from cavmarl.parallel.placement.backend_name import BackendName, read_backend


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("local", BackendName("local")),
        ("processes:4", BackendName("processes", 4)),
        ("nodes:2", BackendName("nodes", 2)),
        ("nodes:2@10.0.0.1:7600", BackendName("nodes", 2, ("10.0.0.1", 7600))),
        ("nodes:2@[::1]:7600", BackendName("nodes", 2, ("[::1]", 7600))),
        ("nodes:2@mpi", BackendName("nodes", 2, "mpi")),
        ("ray:8", BackendName("ray", 8)),
        ("ray", BackendName("ray")),
        ("moon", BackendName("moon")),
        ("moon:3", BackendName("moon", 3)),
    ],
)
def test_each_form_of_a_backend_name_is_read_and_written(text: str, name: BackendName) -> None:
    assert read_backend(text, registered={"moon"}) == name
    assert str(name) == text


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({}, "local"),
        ({"workers": 0}, "local"),
        ({"workers": np.int64(3)}, "processes:3"),
        ({"nodes": 2}, "nodes:2"),
        ({"workers": 3, "backend": "processes:3"}, "processes:3"),
        ({"nodes": 2, "backend": "nodes:2"}, "nodes:2"),
        ({"workers": 0, "backend": "local"}, "local"),
    ],
)
def test_workers_and_nodes_are_short_forms_of_backends(
    arguments: dict[str, Any], text: str
) -> None:
    assert str(read_backend(**{"backend": None, **arguments})) == text


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            {"backend": "mars"},
            r"'mars': there is no backend 'mars'; use one of 'local', 'proc.*regi",
        ),
        ({"backend": ""}, "there is no backend ''"),
        ({"backend": 3}, "backend = 3: must be a string"),
        ({"backend": "local:2"}, "'local' has no number"),
        ({"backend": "processes"}, "the number is missing; use 'processes:2'"),
        ({"backend": "nodes"}, "the number is missing; use 'nodes:2'"),
        ({"backend": "processes:0"}, "the number '0' must be 1 or more"),
        ({"backend": "processes:-1"}, "the number '-1' must be 1 or more"),
        ({"backend": "ray:"}, "the number '' must be 1 or more; use 'ray:2'"),
        ({"backend": "ray:²"}, "the number '²' must be 1 or more"),
        ({"backend": "ray:2@10.0.0.1:7600"}, "only nodes are started by hand; use 'ray:2'"),
        ({"backend": "nodes:2@here"}, "'here': must be HOST:PORT"),
        ({"backend": "nodes@mpi"}, "there is no backend 'nodes@mpi'"),
        ({"backend": "ray:2@mpi"}, "only nodes are started by hand; use 'ray:2'"),
        ({"backend": "nodes:2@"}, "'': must be HOST:PORT"),
        ({"backend": "nodes:2@10.0.0.1:70000"}, "must be HOST:PORT"),
        ({"workers": "ray"}, "workers = 'ray': must be a whole number; use backend='ray'"),
        ({"workers": 2.0}, "workers = 2.0: must be a whole number"),
        ({"workers": True}, "workers = True: must be a whole number"),
        ({"workers": -1}, "workers = -1: must be a number from 0; use 0"),
        ({"nodes": 0}, "nodes = 0: must be a number from 1; leave it out"),
        ({"nodes": 2, "workers": 2}, "short for backend = 'processes:2'; leave out workers, or no"),
        ({"workers": 2, "backend": "ray:2"}, "leave out workers, or backend"),
        ({"workers": 0, "backend": "ray:2"}, "short for backend = 'local'; leave out workers"),
        ({"nodes": 2, "backend": "nodes:2@10.0.0.1:7600"}, "leave out nodes, or backend"),
        ({"hosts": "ray"}, "hosts was removed: use backend='ray:N'"),
    ],
)
def test_bad_backends_are_refused(arguments: dict[str, Any], words: str) -> None:
    for make in (cavmarl.make_vec, cavmarl.parallel_env):
        with pytest.raises(ConfigError, match=words):
            make("ring", **arguments)
