"""The small integer codes in records; kernels compare against these names."""

from __future__ import annotations

# VEHICLE["driver"]
DRIVER_BACKGROUND = 0  # moves along lanes, driven by the models of driving/kernels/drivers.py
DRIVER_AGENT = 1  # kinematic bicycle, driven by actions
DRIVER_SCRIPTED = 2  # moves by its script: pedestrians, vehicles of scenarios
DRIVER_SUMO = 3  # moved by SUMO, copied to the rows
DRIVER_EXTERNAL = 4  # posed or driven by the caller, see `records.external_records`
DRIVER_LEARNED = 5  # background vehicle: kinematic bicycle, driven by the network of its VTYPE

# VTYPE["vclass"] of pedestrians; the classes of vehicles are positions in network.VEHICLE_CLASSES
CLASS_PEDESTRIAN = 9

# VTYPE["model"]: the car-following models, a file each in driving/kernels/models
MODEL_KRAUSS = 0
MODEL_IDM = 1
MODEL_ACC = 2

# Kinds of insertions into a running world, `Commands.inserted`.
INSERT_NONE = 0
INSERT_VEHICLE = 1

# DEPARTURE["lane_code"]: the lane of its edge on which a vehicle enters, as SUMO's `departLane`.
# Only lanes count that are open and from which the vehicle can reach its goal.
LANE_GIVEN = 0
LANE_FIRST = -1  # the lane nearest to the kerb
LANE_RANDOM = -2
LANE_FREE = -3  # the lane with the fewest vehicles
LANE_ALLOWED = -4  # treated like LANE_FREE
LANE_BEST = -5  # as LANE_FREE, among the lanes that the route follows furthest without a change

# DEPARTURE["pos_code"]: the position on the lane, as SUMO's `departPos`
POS_GIVEN = 0
POS_BASE = 1  # rear bumper at the start of the lane
POS_RANDOM = 2  # a random place, drawn again in each tick until the vehicle can enter
POS_FREE = 3  # treated like POS_RANDOM
POS_RANDOM_FREE = 4  # treated like POS_RANDOM
POS_LAST = 5  # behind the last vehicle

# DEPARTURE["speed_code"]: the initial speed, as SUMO's `departSpeed`
SPEED_GIVEN = 0
SPEED_RANDOM = 1
SPEED_MAX = 2  # the highest safe speed
SPEED_DESIRED = 3  # limit times speed factor
SPEED_LIMIT = 4
SPEED_LAST = 5  # speed of the last vehicle on the lane
SPEED_AVERAGE = 6  # mean speed of the vehicles on the lane

# STOP["until_from"]: the time to which the earliest end of a stop (`until`) is relative
UNTIL_ABSOLUTE = 0
UNTIL_FLOW = 1
UNTIL_DEPARTURE = 2

# VEHICLE["hold"]: the reason why a driver is stopped or will stop
HOLD_NONE = 0
HOLD_SIGNAL = 1  # red or yellow
HOLD_YIELD = 2  # gives way
HOLD_EXIT_BLOCKED = 3  # no room beyond the junction, or a vehicle on the junction blocks the path

# VEHICLE["events"]: bits, events of this step
EVENT_COLLIDED = 1
EVENT_OFF_ROAD = 2
EVENT_WRONG_WAY = 4
EVENT_RED_LIGHT = 8
EVENT_ARRIVED = 16
EVENT_OUT_OF_TIME = 32  # its trip has exceeded its time limit
EVENTS_OF_FATE = EVENT_COLLIDED | EVENT_OFF_ROAD | EVENT_ARRIVED  # have priority over OUT_OF_TIME
EVENTS_THAT_END = EVENTS_OF_FATE | EVENT_OUT_OF_TIME

# VEHICLE["transfer"]: the row is owned. Rows are saved and sent in this state only; others are
# reserved.
AUTHORITATIVE = 0

# Letters of signals as codes: positions in roads.network.SIGNAL_STATES = "rugGysoOY".
SIGNAL_RED = 0
SIGNAL_RED_YELLOW = 1
SIGNAL_GREEN_MINOR = 2  # go, but yield
SIGNAL_GREEN_MAJOR = 3
SIGNAL_YELLOW_MINOR = 4
SIGNAL_STOP_THEN_GO = 5
SIGNAL_OFF_BLINKING = 6  # yield as without a signal
SIGNAL_OFF = 7
SIGNAL_YELLOW_MAJOR = 8
SIGNAL_NONE = 255  # the link has no signal

# PROGRAM["detector_gap_s"] of programs whose phases an agent chooses
CHOSEN_BY_AGENT = -1.0

# highway-env's five meta-actions
ACTION_LANE_LEFT = 0
ACTION_IDLE = 1
ACTION_LANE_RIGHT = 2
ACTION_FASTER = 3
ACTION_SLOWER = 4

# DepartureQueue.counts, since reset
COUNT_DEPARTED = 0  # vehicles that have entered
COUNT_ARRIVED = 1  # vehicles that reached their goal
COUNT_REMOVED = 2  # vehicles that left without reaching their goal, for example after a collision
COUNT_REROUTED = 3  # vehicles that left their route for another route
NUM_COUNTS = 4

# DepartureQueue.sums, over vehicles that arrived
SUM_DISTANCE_M = 0
SUM_TIME_S = 1
SUM_DELAY_S = 2  # trip time minus time at the speed that limit, driver and type allow
NUM_SUMS = 3

# In LANE["permissions"], bit NO_CHANGE_LEFT + k (NO_CHANGE_RIGHT + k) bars vehicle class k from
# changing to the left (right).
NO_CHANGE_LEFT = 12
NO_CHANGE_RIGHT = 22
