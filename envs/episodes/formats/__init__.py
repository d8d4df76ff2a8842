"""Formats of recorded episodes: LeRobot's, read and written, and other people's."""
