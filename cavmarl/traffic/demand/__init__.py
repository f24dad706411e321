"""Demand from SUMO's files: vehicles with departures, origins, destinations and types."""

from __future__ import annotations

from cavmarl.traffic.demand.demand_file import DemandFile, read_demand
from cavmarl.traffic.demand.demand_records import STOP, Choices

__all__ = ["STOP", "Choices", "DemandFile", "read_demand"]
