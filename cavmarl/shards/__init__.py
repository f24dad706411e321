"""One zone's sub-worlds: vehicles, sensors, and the phases of a tick.

Calls the kernels of `driving`, `traffic` and `sensors`; `engine` orders its phases.
"""
