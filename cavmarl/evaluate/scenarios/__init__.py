"""Tests of drivers in scenarios: criticality, verdicts, films, sweeps over maps."""
