"""What a network that was trained for a robot is worth on shapes that it has not seen, and its learning curve."""
