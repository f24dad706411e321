"""ROS 2 without a ROS installation: topics of a world over DDS, and bags."""
