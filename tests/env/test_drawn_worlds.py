"""Pictures of worlds do not depend on the processes that run them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from cavmarl import ConfigError, make_vec, parallel_env

pytest.importorskip("pygame", reason="needs the extra: render")
SMALL: dict[str, Any] = {"agents": 3, "background": 10, "render_mode": "rgb_array"}


@pytest.mark.parametrize(
    "elsewhere",
    [{"zones": 2, "nodes": 2}, {"workers": 1}, {"zones": 2, "workers": 2, "num_envs": 1}],
)
@pytest.mark.filterwarnings("ignore:workers = ")
def test_pictures_of_several_processes_equal_those_of_one_process(
    elsewhere: dict[str, Any],
) -> None:
    num_envs, zones = elsewhere.get("num_envs", 2), elsewhere.get("zones", 1)
    pictures = []
    for more in ({"zones": zones}, elsewhere):
        vec = make_vec("grid4x4", **{"num_envs": num_envs, **SMALL, **more})
        vec.reset(seed=4)
        found = []
        for _ in range(3):
            vec.step(vec.suggest_actions())
            frames = vec.render()
            assert frames is not None
            found += frames
        vec.close()
        pictures.append(found)
    assert len(pictures[0]) == 3 * num_envs
    assert pictures[0][0].std() > 0.0
    assert not np.array_equal(pictures[0][0], pictures[0][-1])
    for one, other in zip(*pictures, strict=True):
        assert np.array_equal(one, other)


def test_a_world_over_nodes_is_drawn() -> None:
    env = parallel_env("grid4x4", zones=2, nodes=2, **SMALL)
    env.reset(seed=1)
    picture = env.render()
    env.close()
    assert picture is not None
    assert picture.std() > 0.0


def test_bad_input_is_refused() -> None:
    sumo = {
        "traffic.source": "sumo-traffic",
        "traffic.demand": ["a.rou.xml"],
        "sensors.signal.timing": False,
    }
    with pytest.raises(ConfigError, match=r"source = 'sumo-traffic': such worlds can only"):
        make_vec("grid4x4", workers=1, overrides=sumo, **SMALL)
