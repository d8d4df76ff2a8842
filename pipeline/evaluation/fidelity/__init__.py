"""How like the truth generated video is, under true actions."""
