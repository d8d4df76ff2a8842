"""A person in the policy's place: keys or recorded actions move a robot, in physics or imagined."""
