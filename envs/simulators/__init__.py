"""Learned worlds. base.py has the contract; unet.py and dit.py generate frames; state_*.py decode joint
states.
"""
