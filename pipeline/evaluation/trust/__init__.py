"""How much of what reinforcement learning learns from is true: futures compared, and gradients."""
