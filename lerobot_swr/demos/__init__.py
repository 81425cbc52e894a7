"""Scripted demonstrators and the recipes that turn them into LeRobot datasets."""
