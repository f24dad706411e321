"""Motion: the update of a vehicle's state from one tick to the next.

Read `motion` first. While drivers decide, `speed_limits_ahead` and `ordered_stops` limit their
speed. Then `motion` moves background vehicles along their lanes. For agents' vehicles, `steering`
converts the action to throttle and steering angle with the controllers of `highway_control`,
`bicycle` integrates the motion, and `tracking` finds the vehicle's lane. `scripted_rows` moves
pedestrians and the vehicles of scenarios. When all vehicles have moved, `contacts` finds the
vehicles that touch. `steered_drive` and `trial_drive` drive a car over a turn before the first
step, to measure the map.
"""
