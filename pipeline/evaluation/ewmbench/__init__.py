"""EWMBench (Genie Envisioner, 6): is the scene kept, does the hand move as it should, is the task told."""
