"""What this package adds to PushT, the task of gym-pusht (LeRobot's own ``--env.type=pusht``).

* `block`: the T-shaped block: its pose, its cover of the goal and its sides, from its keypoints.
* `behavior`: which behaviour an episode shows (needs no simulator).
* `task`: what evaluations ask of the environment.
"""
