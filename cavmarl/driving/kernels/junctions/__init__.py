"""Right of way: whether a driver may enter a junction, or go on from a place inside.

Open `junctions` first. Before any driver decides, `approach` registers each vehicle at the links
that it is on and that it takes next; `stop_line_registration` says from which distance on, and
for which of them no driver has to wait. Then `junctions` checks for each driver that comes to a
line the signal, the foes with the right of way (`gaps`) and circles of vehicles that wait for one
another (`deadlocks`). `drivers` adds the areas that long or steered vehicles sweep over
(`swept_areas`). `signal_timing` predicts the next change of a signal for roadside units; no driver
uses it.
"""
