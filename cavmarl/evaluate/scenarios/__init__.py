"""Scenarios as tests: criticality, verdicts, films, sweeps over maps."""
