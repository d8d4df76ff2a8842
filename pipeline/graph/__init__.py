"""The stage graph: what a stage is, what it may read, when it runs again."""
