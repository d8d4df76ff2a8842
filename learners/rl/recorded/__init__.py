"""What recordings of physics say, where reinforcement learning learns in imagination."""
