"""Sweeps of scenarios over maps and seeds, as `cavmarl scenario sweep` prints them.

One driver must pass. Another driver, which ignores all others, must fail: a scenario that it passes
tests nothing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

from cavmarl.core.errors import ScenarioError
from cavmarl.evaluate.scenarios.scenario_runs import ScenarioRun, make_scenario, run_scenario


class SweepRow(NamedTuple):
    """One scenario on one map."""

    scenario: str  # name of the scenario
    environment: str  # name, folder or map file
    # runs of the driver that must pass; empty if the map has no place
    passing: list[ScenarioRun]
    failing: list[ScenarioRun]  # runs of the driver that must fail

    @property
    def holds(self) -> bool:
        """True if one driver passed all runs and the other driver none."""
        return all(run.passed for run in self.passing) and not any(
            run.passed for run in self.failing
        )

    @staticmethod
    def verdicts(runs: Sequence[ScenarioRun]) -> str:
        """Return the counts of verdicts, for example `5 passed`."""
        counts = Counter(run.verdict for run in runs)
        return ", ".join(f"{number} {verdict}" for verdict, number in sorted(counts.items()))

    def least(self, name: str) -> float | None:
        """Return the least value of a measure over the runs that must pass; None: never defined."""
        values = [getattr(run, name) for run in self.passing]
        return min((value for value in values if value is not None), default=None)

    def to_dict(self) -> dict[str, Any]:
        plain = {"scenario": self.scenario, "environment": self.environment, "holds": self.holds}
        sides = {"passing": self.passing, "failing": self.failing}
        return plain | {side: [asdict(run) for run in runs] for side, runs in sides.items()}


def sweep_scenarios(
    scenarios: Sequence[str],
    maps: Sequence[str | Path],
    seeds: Sequence[int],
    *,
    passes: str = "idm",
    fails: str = "never_yield",
    density: str = "none",
    agents: int = 1,
    overrides: Mapping[str, Any] | None = None,
) -> Iterator[SweepRow]:
    """Run each scenario on each map once per seed, with two drivers.

    Args:
        scenarios: names, or paths of files.
        maps: names, folders or map files of environments.
        seeds: seeds of place and traffic.
        passes: driver that must pass.
        fails: driver that must fail.
        density: density of the other traffic.
        agents: number of agents in each run.
        overrides: values of further keys of the environments.

    Raises:
        ConfigError: an unknown scenario, or no room for the agents; as in `make_scenario`.
    """
    for scenario in scenarios:
        for env in maps:
            row = SweepRow(scenario, str(env), [], [])
            for seed in seeds:
                try:
                    vec = make_scenario(
                        scenario,
                        env,
                        density=density,
                        seed=seed,
                        agents=agents,
                        overrides=overrides,
                    )
                except ScenarioError:
                    break
                with closing(vec):
                    row.passing.append(run_scenario(vec, passes, seed))
                    row.failing.append(run_scenario(vec, fails, seed))
            yield row
