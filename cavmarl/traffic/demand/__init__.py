"""Demand from SUMO's files: vehicles with their departures, origins, destinations and types."""

from __future__ import annotations

from cavmarl.traffic.demand.demand_file import DemandFile, read_demand
from cavmarl.traffic.demand.demand_records import ELEMENT, ORDER, ROUTE, STOP, Choices
from cavmarl.traffic.demand.element import DemandReport

__all__ = [
    "ELEMENT",
    "ORDER",
    "ROUTE",
    "STOP",
    "Choices",
    "DemandFile",
    "DemandReport",
    "read_demand",
]
