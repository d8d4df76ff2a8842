"""What separate commands measured of one simulator, on one page."""
