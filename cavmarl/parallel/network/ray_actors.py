"""`RayActors`: nodes as actors of Ray, which starts and restarts them."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

from cavmarl.core.errors import WorkerError, require
from cavmarl.parallel.network.ray_cluster import choose_nodes, join, leave, nodes_with

END_S = 3.0  # time for actors to return: Ray prints an error for each killed actor
SPARES = 1  # number of spare actors, which replace dead actors at once; a start takes seconds

Main = Callable[[tuple[str, int], bytes, int], None]


class NodeActor:
    """The class of the actors. An actor executes a single call, which lasts for its life."""

    def run(self, main: Main, place: tuple[str, int], secret: bytes, number: int) -> None:
        main(place, secret, number)


class RayActors:
    """Actors on the nodes of a Ray cluster.

    If an actor dies, Ray restarts it on the same node of the cluster, or on another node if that
    node is lost, and repeats its call. Ray carries no data of steps: it only passes the function to
    run, the place of the caller, and the secret.

    Attributes:
        address: address of this machine in the cluster.
        workers: number of actors, without spare actors.

    Raises:
        MissingExtraError: Ray is not installed.
        ConfigError: this program is not on a node of the cluster, or there are too few CPUs.
        NoAdmissibleWorkerError: all nodes are too busy.
        WorkerError: there is no cluster.
    """

    def __init__(
        self,
        main: Main,  # what each actor runs: a function of a module that every node can import
        workers: int | None,  # actors with a CPU of their own; None: as many as there are free CPUs
        at_most: int,  # largest useful number of actors
    ) -> None:
        self._main = main
        self._actors: list[Any] = []
        self._calls: list[Any] = []
        self._ray: Any = require("ray", "ray")
        has_joined = join()
        self._finalizer = weakref.finalize(
            self, _end, self._ray, self._actors, self._calls, has_joined
        )
        try:
            known = nodes_with(at_most if workers is None else workers)
            free = sum(node.cpus for node in known)
            self.workers = max(1, min(free, at_most)) if workers is None else workers
            # A spare actor on this node survives the loss of another node.
            self._nodes = [*choose_nodes(known, self.workers), *[known[0].name] * SPARES]
            self.address: str = self._ray.util.get_node_ip_address()
        except BaseException:
            self.close()
            raise

    def start(self, place: tuple[str, int], secret: bytes) -> None:
        for number, node in enumerate(self._nodes):
            try:
                self._start(number, node, place, secret)
            except self._ray.exceptions.RayError as error:
                raise WorkerError(f"Ray cannot start node {number}: {error}") from error

    def _start(self, number: int, node: str, place: tuple[str, int], secret: bytes) -> None:
        strategies = self._ray.util.scheduling_strategies
        actor = self._ray.remote(NodeActor).options(
            num_cpus=1 if number < self.workers else 0,
            max_restarts=-1,
            max_task_retries=-1,
            scheduling_strategy=strategies.NodeAffinitySchedulingStrategy(node, soft=True),
        )
        self._actors.append(actor.remote())
        call = self._actors[-1].run.remote(self._main, place, secret, number)
        self._calls.append(call)

    def restart(self, number: int) -> None:
        """Kill an actor that may still run; Ray restarts it."""
        self._ray.kill(self._actors[number], no_restart=False)

    def trouble(self) -> str | None:
        """Return the error of an actor whose call has failed; None: no call has failed."""
        ended, _ = self._ray.wait(self._calls, num_returns=len(self._calls), timeout=0)
        for call in ended:
            try:
                self._ray.get(call)
            except self._ray.exceptions.RayError as error:
                return str(error)
        return None

    def close(self) -> None:
        """End all actors, and leave the cluster if no other part of the program needs it."""
        self._finalizer()


def _end(ray: Any, actors: Sequence[Any], calls: Sequence[Any], has_joined: bool) -> None:
    if not ray.is_initialized():  # the program has shut Ray down
        return
    if calls:
        ray.wait(calls, num_returns=len(calls), timeout=END_S)
    for actor in actors:
        ray.kill(actor, no_restart=True)
    if has_joined:
        leave()
