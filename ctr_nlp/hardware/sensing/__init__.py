"""Where measurements of the robot come from while a plan is played: links, messages, and clocks."""
