"""The D3IL robot tasks *avoiding* and *aligning*, rebuilt in MuJoCo from published facts.

A Franka arm holds a rod and follows set-points of its tool centre point (Jia et al., "Towards Diverse
Behaviors: A Benchmark for Imitation Learning with Human Demonstrations", ICLR 2024). Reading order:

* `layouts`: where things stand, how far "done" is (numbers only).
* `arm`, `scene`: the MuJoCo model. `controller`, `simulation`: the 1 kHz control of the arm.
* `avoiding`, `aligning`: the Gymnasium environments. `rendering`: their pictures.
* `behavior`: which behaviour an episode shows (needs no simulator).
* `configuration_d3il`: the LeRobot environment type ``d3il``.
"""
