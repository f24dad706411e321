"""The small integers that records carry, in one place; kernels compare against these names."""

from __future__ import annotations

# VEHICLE["driver"]
DRIVER_BACKGROUND = 0  # moves along lanes, driven by the models of driving/kernels/drivers.py
DRIVER_AGENT = 1  # kinematic bicycle, driven by actions
DRIVER_SCRIPTED = 2  # goes where its script says: pedestrians, vehicles of scenarios

# VTYPE["vclass"] of pedestrians; the classes that drive are positions in network.VEHICLE_CLASSES
CLASS_PEDESTRIAN = 9
DRIVER_SUMO = 3  # moved by SUMO, mirrored here

# VTYPE["model"]: the car-following models, a file each in driving/kernels/models
MODEL_KRAUSS = 0
MODEL_IDM = 1
MODEL_ACC = 2

# DEPARTURE["lane_code"]: on which lane of its edge a vehicle enters
# What is put into a world while it runs, `Commands.inserted`.
INSERT_NONE = 0
INSERT_VEHICLE = 1
INSERT_BARRIER = 2  # it stands until its lane is opened, or to the end of the episode
INSERT_OPEN = 3  # a lane: its barrier drives on, or is not put there

LANE_GIVEN = 0
LANE_FIRST = -1  # the one nearest to the kerb of those that it may use
LANE_RANDOM = -2
LANE_FREE = -3  # the least occupied one
LANE_ALLOWED = -4
LANE_BEST = -5  # one from which its way goes on without a lane change

# DEPARTURE["pos_code"]: where on the lane
POS_GIVEN = 0
POS_BASE = 1  # the rear bumper at the start of the lane
POS_RANDOM = 2
POS_FREE = 3
POS_RANDOM_FREE = 4
POS_LAST = 5  # behind the last vehicle

# DEPARTURE["speed_code"]: how fast
SPEED_GIVEN = 0
SPEED_RANDOM = 1
SPEED_MAX = 2  # the most that is safe there
SPEED_DESIRED = 3
SPEED_LIMIT = 4
SPEED_LAST = 5  # of the last vehicle on the lane
SPEED_AVERAGE = 6

# STOP["until_from"]: what the time of leaving is counted from
UNTIL_ABSOLUTE = 0
UNTIL_FLOW = 1
UNTIL_DEPARTURE = 2

# VEHICLE["hold"]: why a driver stands or will stop
HOLD_NONE = 0
HOLD_SIGNAL = 1  # red or yellow
HOLD_YIELD = 2  # gives way
HOLD_EXIT_BLOCKED = 3  # no room beyond the junction, or one that stays on it is in the way

# VEHICLE["events"]: bits, what happened in this step
EVENT_COLLIDED = 1
EVENT_OFF_ROAD = 2
EVENT_WRONG_WAY = 4
EVENT_RED_LIGHT = 8
EVENT_ARRIVED = 16
EVENT_OUT_OF_TIME = 32  # its trip has taken longer than it may
EVENTS_OF_FATE = EVENT_COLLIDED | EVENT_OFF_ROAD | EVENT_ARRIVED  # each ends a trip before that
EVENTS_THAT_END = EVENTS_OF_FATE | EVENT_OUT_OF_TIME

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

# DepartureQueue.counts, since reset
COUNT_DEPARTED = 0  # vehicles that have entered
COUNT_ARRIVED = 1  # vehicles that reached their goal
COUNT_REMOVED = 2  # agents taken out after a collision or off the road
COUNT_REROUTED = 3  # vehicles that left their route for another way
NUM_COUNTS = 4

# DepartureQueue.sums, over vehicles that arrived
SUM_DISTANCE_M = 0
SUM_TIME_S = 1
SUM_DELAY_S = 2  # time above what the way takes at the speed that limit and driver allow
NUM_SUMS = 3
