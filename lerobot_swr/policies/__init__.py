"""The policies BC, ZBC and WZBC as LeRobot's configuration / modeling / processor trio."""
