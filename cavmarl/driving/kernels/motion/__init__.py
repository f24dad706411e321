"""Motion: how a vehicle gets from its state of one tick to that of the next.

Open `motion` first. While drivers decide, `speed_limits_ahead` and `ordered_stops` limit their
speed. Afterwards `motion` moves background vehicles along their lanes. An agent's action becomes
throttle and steering (`steering`, with the controllers of `highway_control`), `bicycle` integrates
it, and `tracking` finds the lane that the vehicle is on. `scripted_rows` moves pedestrians and the
vehicles of scenarios. When all rows have moved, `contacts` finds those that touch. `steered_drive`
and `trial_drive` drive a car over a turn before the first step, to measure the map.
"""
