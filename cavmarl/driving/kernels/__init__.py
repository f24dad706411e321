"""Compiled loops of the drivers: what each vehicle decides in a tick, and how it moves.

Open `drivers` first: `decide` goes through the vehicles of one world, and calls the folders in this
order. The index of lanes (`lanes.lane_index`) and the lists of junctions (`junctions.approach`) are
built once a tick, before any driver decides.

1. `junctions`: which line or foe stops a driver ahead,
2. `models`: how hard a driver accelerates behind all that stands ahead,
3. `lanes`: whether it changes lanes,
4. `motion`: how the decision, or an agent's action, moves the vehicle; and contacts afterwards.
"""
