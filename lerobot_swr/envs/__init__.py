"""The simulated tasks, each a Gymnasium environment with its LeRobot `EnvConfig` and its behaviour rule."""
