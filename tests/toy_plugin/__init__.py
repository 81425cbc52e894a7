"""A policy as a third-party plugin of LeRobot brings it; it knows nothing of this package."""
