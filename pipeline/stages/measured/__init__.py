"""Stages that measure: worlds and judges for studies, and how widely a first policy may explore."""
