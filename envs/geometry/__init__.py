"""Rigid motions, pinhole cameras and forward kinematics."""
