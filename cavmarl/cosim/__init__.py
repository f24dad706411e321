"""Co-simulation: a master advances the world's time, and other processes (followers) wait for it.

Followers are driving stacks, ROS 2 nodes and CARLA's clients. Depends on `env`; `cli` starts worlds
and followers.
"""
