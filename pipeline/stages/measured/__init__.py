"""Stages that only studies have: what is measured of worlds and judges beside what a run measures of them."""
