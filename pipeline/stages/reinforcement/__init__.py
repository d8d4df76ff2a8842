"""Stages of reinforcement learning, and what truth tells them: which tasks to imagine, how a policy does."""
