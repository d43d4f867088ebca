"""Motors behind a ROS 2 joint_trajectory_controller, spoken to without ROS."""
