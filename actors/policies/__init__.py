"""Policies: what turns views, state and words into chunks of actions."""
