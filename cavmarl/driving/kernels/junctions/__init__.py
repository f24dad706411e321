"""Right of way: whether a driver may enter a junction, or leave a waiting position inside.

Read `junctions` first. Before any driver decides, `approach` registers each vehicle at the link
that it is on and at the links that it takes next. `stop_line_registration` defines the distance at
which a vehicle registers, and the registered vehicles for which no driver has to wait. For each
driver that approaches a stop line, `junctions` then checks the signal, the foes with the right of
way (`gaps`), and cycles of vehicles that wait for one another (`deadlocks`). `drivers` adds the
areas that long or steered vehicles sweep over (`swept_areas`). A *constraint* limits a driver's
acceleration, see `models.car_following_model`. `signal_timing` predicts the next change of a signal
for roadside units; no driver uses it.
"""
