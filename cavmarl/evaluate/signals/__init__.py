"""Compares controllers of signals with each other and with SUMO under the map's own programs."""
