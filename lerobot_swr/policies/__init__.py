"""The policies BC, ZBC and WZBC as LeRobot configuration / modeling / processor trio."""
