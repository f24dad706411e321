"""Lanes: which vehicles are near on them, and which lane a driver takes.

Open `lane_choice` first. Before any driver decides, `lane_index` sorts the vehicles by lane and
position. In a tick a driver follows its route from lane to lane (`route_following`), minds leaders
on neighbour lanes (`adjacent_leaders`) and the end of its lane (`lane_ends`), and then chooses a
lane: `lane_choice` finds the vehicles concerned, `lane_change` weighs the change by MOBIL, and
`side_clearance` checks that no stopped vehicle is in the way. At last, followers on the target lane
brake for vehicles that have to change (`cooperative_braking`).
"""
