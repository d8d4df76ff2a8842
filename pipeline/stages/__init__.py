"""What each stage of the loop does; a file is a stage or a few that belong together (see pipeline/stage.py)."""
