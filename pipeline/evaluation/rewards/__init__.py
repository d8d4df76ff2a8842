"""Rewards and judges side by side: what they are compared by, and the page."""
