"""State experts: the robot's state, read off a simulator's features."""
