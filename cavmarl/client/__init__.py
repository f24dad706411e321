"""A client of the coordination service: worlds on other machines, evaluations and events.

    from cavmarl.client import Client

    with Client("http://127.0.0.1:8700", secret=secret) as client:
        with client.open("merge", agents=8) as world:     # steps like `make_vec`
            observations, infos = world.reset(seed=0)
            observations, rewards, terminations, truncations, infos = world.step(actions)
        job = client.submit("merge", policies=["idm"], episodes=8)
        client.wait(job, folder="runs/there")

`AsyncClient` has the same methods as coroutines. Both need the extra `service`.
"""

from cavmarl.core.errors import require

require("httpx", "service")

from cavmarl.client.clients import AsyncClient, AsyncWorld, Client, RemoteWorld  # noqa: E402

__all__ = ["AsyncClient", "AsyncWorld", "Client", "RemoteWorld"]
