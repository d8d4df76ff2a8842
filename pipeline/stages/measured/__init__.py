"""Stages that only studies have: what is measured of imagined worlds and of judges beside what a run measures."""
