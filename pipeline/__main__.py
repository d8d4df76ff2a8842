"""`python -m pipeline` is the console script `worldloop`."""

from pipeline.cli import main

main()
