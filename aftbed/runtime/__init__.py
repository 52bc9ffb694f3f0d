"""The executive support: what the paper asked of ROS and did not get."""
