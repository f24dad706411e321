"""ROS 2 without a ROS installation: topics of a world over DDS, and bags."""

from pathlib import Path

# Profile for nodes with Fast DDS; docs/reference/ros2.md says what it sets.
FAST_DDS_PROFILE = Path(__file__).with_name("fast_dds.xml")
