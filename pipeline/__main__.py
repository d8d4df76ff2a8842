"""`python -m pipeline` is the console script `worldloop`."""

from pipeline.cli.main import main

main()
