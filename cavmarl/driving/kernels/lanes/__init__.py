"""Lanes: the vehicles near a driver, and the lane that the driver chooses.

Read `lane_choice` first. Before any driver decides, `lane_index` sorts the vehicles by lane and
position. In a tick, a driver follows its route from lane to lane (`route_following`), reacts to
leaders on adjacent lanes (`adjacent_leaders`) and to the end of its lane (`lane_ends`), and then
chooses a lane: `lane_choice` finds the vehicles concerned, `lane_change` evaluates the change by
MOBIL, and `side_clearance` checks that no stopped vehicle is in the way. Finally, followers on the
target lane brake for vehicles that have to change lanes (`cooperative_braking`).
"""
