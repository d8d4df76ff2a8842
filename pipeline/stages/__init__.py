"""What each stage of the loop does; a file is a stage or a few of them (see pipeline/graph/stage.py)."""
