"""Commands that say how far an imagined world can be trusted; what they share stands in subject.py."""
