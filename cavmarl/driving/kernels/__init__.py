"""Compiled loops of the drivers: the decision of each vehicle in a tick, and its motion.

Open `drivers` first: `decide` iterates over the vehicles of one world and calls the folders in this
order. The index of lanes (`lanes.lane_index`) and the lists of approaching vehicles
(`junctions.approach`) are built once per tick, before any driver decides.

1. `junctions`: the stop lines and foes at which a driver has to stop.
2. `models`: the acceleration behind leaders and before stop lines.
3. `lanes`: lane changes.
4. `motion`: the motion that follows from the decision or from an agent's action, then contacts.
"""
