"""Where grippers are: as robots know it, and as a detector that is taught by that sees them in pictures."""
