"""Metrics of the service in the format of Prometheus, collected on request."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector as PrometheusCollector

from cavmarl.service.broker import Broker
from cavmarl.service.node_selection import score_of

BUCKETS_S = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.5)
_TOLD = {  # reported by nodes with their heartbeats
    "ticks": "Ticks of worlds.",
    "steps": "Steps of worlds.",
    "wait_s": "Seconds that commands of clients waited for other commands.",
    "transfers": "Vehicles that changed the zone that owns them.",
}


class ServiceMetrics(PrometheusCollector):
    """Metrics of a broker, and counts of requests that were `rejected`, by problem."""

    def __init__(self, broker: Broker, rejected: Mapping[str, int]) -> None:
        self._broker, self._rejected = broker, rejected
        self._registry = CollectorRegistry()
        name, text = "cavmarl_selection_seconds", "Time to choose a node."
        histogram = Histogram(name, text, buckets=BUCKETS_S, registry=self._registry)
        broker.took_s = histogram.observe
        self._registry.register(self)

    def text(self) -> str:
        """Return the metrics as text."""
        return generate_latest(self._registry).decode()

    def collect(self) -> Iterator[Metric]:
        """Yield the families of metrics for the registry."""
        broker, state = self._broker, self._broker.log.state
        states = Counter(
            "draining" if node.state == "up" and node.draining else node.state
            for node in state.nodes.values()
        )
        yield _gauge("nodes", "Nodes by state.", "state", states)
        kinds = Counter(
            f"{'world' if one.job is None else 'job'}_{one.state}"
            for one in state.sessions.values()
        )
        yield _gauge("sessions", "Sessions and jobs by state.", "state", kinds)
        live = broker.live
        scores = {
            name: score
            for name, node in state.nodes.items()
            if (score := score_of(node, live[name], broker.rules.load)) is not None
        }
        yield _gauge("node_load_score", "LoadScore of a node, eq. (1).", "node", scores)
        hosted = {name: len(one.hosted) for name, one in live.items()}
        yield _gauge("node_sessions", "Sessions and jobs of a node.", "node", hosted)
        for counter, text in _TOLD.items():
            family = CounterMetricFamily(f"cavmarl_node_{counter}", text, labels=["node"])
            for name, one in live.items():
                if counter in one.counters:
                    family.add_metric([name], one.counters[counter])
            yield family
        yield CounterMetricFamily("cavmarl_refusals", "No node was free.", broker.refusals)
        family = CounterMetricFamily(
            "cavmarl_rejections", "Requests that were refused.", labels=["problem"]
        )
        for problem, count in self._rejected.items():
            family.add_metric([problem], count)
        yield family
        yield GaugeMetricFamily("cavmarl_waiting", "Requests that wait.", broker.waiting)
        yield CounterMetricFamily("cavmarl_events", "Events in the log.", broker.log.sequence)


def _gauge(name: str, text: str, label: str, values: Mapping[str, float]) -> Metric:
    family = GaugeMetricFamily(f"cavmarl_{name}", text, labels=[label])
    for key, value in values.items():
        family.add_metric([key], value)
    return family
