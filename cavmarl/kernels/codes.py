"""The small integers that records carry, in one place; kernels compare against these names."""

from __future__ import annotations

# VEHICLE["driver"]
DRIVER_BACKGROUND = 0  # moves along lanes, driven by the models of kernels/drivers.py
DRIVER_AGENT = 1  # kinematic bicycle, driven by actions

# VEHICLE["hold"]: why a driver stands or will stop
HOLD_NONE = 0
HOLD_SIGNAL = 1  # red or yellow
HOLD_YIELD = 2  # gives way
HOLD_EXIT_BLOCKED = 3  # no room beyond the junction

# VEHICLE["events"]: bits, what happened in this step
EVENT_COLLIDED = 1
EVENT_OFF_ROAD = 2
EVENT_WRONG_WAY = 4
EVENT_RED_LIGHT = 8
EVENT_ARRIVED = 16
EVENTS_THAT_END = EVENT_COLLIDED | EVENT_OFF_ROAD | EVENT_ARRIVED

# VEHICLE["transfer"]
AUTHORITATIVE = 0

# Letters of signals as codes: positions in roads.network.SIGNAL_STATES = "rugGysoOY".
SIGNAL_RED = 0
SIGNAL_RED_YELLOW = 1
SIGNAL_GREEN_MINOR = 2  # go, but give way
SIGNAL_GREEN_MAJOR = 3
SIGNAL_YELLOW_MINOR = 4
SIGNAL_STOP_THEN_GO = 5
SIGNAL_OFF_BLINKING = 6  # give way as without a signal
SIGNAL_OFF = 7
SIGNAL_YELLOW_MAJOR = 8
SIGNAL_NONE = 255  # the link has no signal

# highway-env's five meta-actions
ACTION_LANE_LEFT = 0
ACTION_IDLE = 1
ACTION_LANE_RIGHT = 2
ACTION_FASTER = 3
ACTION_SLOWER = 4

# Gate.counts, since reset
COUNT_DEPARTED = 0  # vehicles that have entered
COUNT_ARRIVED = 1  # vehicles that reached their goal
COUNT_REMOVED = 2  # agents taken out after a collision or off the road
NUM_COUNTS = 3

# Gate.sums, over vehicles that arrived
SUM_DISTANCE_M = 0
SUM_TIME_S = 1
SUM_DELAY_S = 2  # time above what the way takes at the limit
NUM_SUMS = 3
