"""What every section of configs/ may hold: names, types and ranges.

Sections that describe an object (`_target_`) are checked against what its class says at its options; those
that become a dataclass elsewhere, against that.
"""
