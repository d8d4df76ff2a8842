"""The command line; commands are functions of runs.py and tools.py."""
