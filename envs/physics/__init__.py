"""True worlds: task suites behind one contract. Only env.py and toy_tracking.py import torch."""
