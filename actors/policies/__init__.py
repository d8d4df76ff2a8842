"""Policies: from views, state and instruction to chunks of actions; contract.py says what they are."""
