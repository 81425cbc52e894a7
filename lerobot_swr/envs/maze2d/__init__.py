"""Maze2D: a light maze with numbered doors, where a behaviour is the order of the doors passed."""
