"""LeRobot data sets: dataset.py reads, writer.py writes, the others say how things are called and stored."""
