"""BC, ZBC and WZBC as LeRobot's configuration / modeling / processor trio; `baselines` beside them."""
