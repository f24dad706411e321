"""A coordination service in this process without a socket; the test advances its clock."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

from cavmarl.service.access import Access
from cavmarl.service.broker import Broker, BrokerRules
from cavmarl.service.configurations import add_configuration, collect_configuration
from cavmarl.service.event_log import EventLog
from cavmarl.service.event_store import EventStore
from cavmarl.service.request_bodies import BeatBody, ConfigurationBody, NodeBody
from cavmarl.service.service_records import IdentityRecord, Role

CONFIGURATION = "0" * 64


class Fleet:
    """A broker with nodes and clients that the test controls."""

    def __init__(self, where: str | Path, *, identities: bool = True, **rules: Any) -> None:
        self.now_s = 1000.0
        self.log = EventLog(EventStore(where), lambda: self.now_s)
        self.access = Access(self.log, lambda: self.now_s)
        self.broker = Broker(self.log, BrokerRules(**rules), lambda: self.now_s)
        self.secrets: dict[str, str] = {}  # by name of the identity
        if identities:
            self.nodes = self.identity("nodes", "node")
            self.client = self.identity("ada", "client")
        self._beats = itertools.count()

    def identity(self, name: str, role: Role) -> IdentityRecord:
        found, self.secrets[name] = self.access.add_identity(name, role)
        return found

    def add_configuration(self, body: ConfigurationBody) -> dict[str, Any]:
        new = collect_configuration(self.log, self.client, body, self.broker.artefacts)
        new.check()
        return add_configuration(self.log, self.client, new)

    def token(self, name: str) -> str:
        return str(self.access.exchange(self.secrets[name])["access_token"])

    def register(self, name: str, **given: Any) -> int:
        body = {"name": name, "address": "127.0.0.1", "client_port": 1, "simulator_port": 2}
        return self.broker.register(self.nodes, NodeBody(**body, **given)).incarnation

    def beat(self, name: str, cpu: float = 0.1, ram: float = 0.1, gpu: float = 0.0) -> Any:
        return self.broker.beat(self.nodes, name, self.beat_of(name, cpu=cpu, ram=ram, gpu=gpu))

    def beat_of(self, name: str, **given: Any) -> BeatBody:
        told = {
            "incarnation": self.log.state.nodes[name].incarnation,
            "sequence": next(self._beats),
            "cpu": 0.1,
            "ram": 0.1,
            "sent_s": self.now_s,
        }
        return BeatBody(**{**told, **given})

    def join(self, *names: str, **given: Any) -> None:
        for name in names:
            self.register(name, **given)
            self.beat(name)

    def open(self, **given: Any) -> Any:
        return self.broker.open(self.client, CONFIGURATION, **given)

    def kinds(self) -> list[str]:
        self.log.flush()
        return [line.kind for line in self.log.store.read()]

    def close(self) -> None:
        self.log.flush()
        self.log.store.close()
