"""Ray clusters that start with the first world and end with the last one; missing clusters."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from cavmarl import ConfigError, make_vec
from cavmarl.core.errors import WorkerError

pytest.importorskip("ray", reason="needs the extra: ray")

pytestmark = pytest.mark.filterwarnings("ignore")  # Ray warns about its own code

ROOT = Path(__file__).resolve().parents[2]

ALONE = """
import psutil, ray
from cavmarl import make_vec

if __name__ == "__main__":
    first, second = (make_vec("ring", backend="ray:1") for _ in range(2))
    assert first.reset(seed=0)[0].tobytes() == second.reset(seed=0)[0].tobytes()
    first.close()
    second.step(second.suggest_actions())
    children = psutil.Process().children(recursive=True)
    second.close()
    assert not ray.is_initialized()
    gone, alive = psutil.wait_procs(children, timeout=20)
    print("left:", [one.cmdline() for one in alive])
"""


def test_a_cluster_that_worlds_started_ends_with_the_last_world() -> None:
    done = subprocess.run(
        [sys.executable, "-c", ALONE], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "left: []"  # no process is left, and Ray has printed nothing
    assert not done.stderr.strip()


NODES = """
import os, psutil, signal, time
from cavmarl import make_vec

if __name__ == "__main__":
    wanted = {"agents": 4, "background": 20}
    one = make_vec("grid4x4", **wanted)
    vec = make_vec("grid4x4", zones=4, backend="ray:2", **wanted)
    for each in (one, vec):
        each.reset(seed=1)
    os.kill(vec.worlds.pool.pids[0], signal.SIGKILL)
    until_s = time.monotonic() + 60.0
    while not vec.worlds.pool.replacements and time.monotonic() < until_s:
        actions = one.suggest_actions()
        for each in (one, vec):
            each.step(actions)
        time.sleep(0.01)
    pool = vec.worlds.pool
    print(one.state_hash() == vec.state_hash(), pool.losses, pool.replacements)
    children = psutil.Process().children(recursive=True)
    vec.close()
    gone, alive = psutil.wait_procs(children, timeout=20)
    print("left:", [one.cmdline() for one in alive])
"""


def test_a_lost_actor_is_restarted() -> None:
    done = subprocess.run(
        [sys.executable, "-c", NODES], cwd=ROOT, capture_output=True, text=True, timeout=180
    )
    assert done.returncode == 0, done.stderr
    said = [line for line in done.stdout.splitlines() if "raylet" not in line]
    assert said[0] == "True 1 1", done.stdout
    assert said[-1] == "left: []"


def test_a_missing_cluster_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:1")
    with pytest.raises(WorkerError, match=r"no Ray cluster at 127.0.0.1:1.*ray start --head"):
        make_vec("ring", backend="ray:1")


def test_the_cluster_file_is_valid_for_ray() -> None:
    from ray.autoscaler._private.util import prepare_config, validate_config

    path = ROOT / "configs/cluster/machines.yaml"
    settings = prepare_config(yaml.safe_load(path.read_text(encoding="utf-8")))
    validate_config(settings)
    (kind,) = settings["available_node_types"].values()
    assert kind["max_workers"] == len(settings["provider"]["worker_ips"])


def test_a_ray_client_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "ray://127.0.0.1:10001")
    with pytest.raises(ConfigError, match="on a machine of the cluster"):
        make_vec("ring", backend="ray:1")
