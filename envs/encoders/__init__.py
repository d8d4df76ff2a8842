"""From pictures and texts to numbers."""
