"""Training of many seeds at once.

* `configuration_training`: LeRobot's training configuration, with seeds.
* `frame_order`: which frames a seed sees at which step, the same as in ``lerobot-train``.
* `stacked_policies`: policies of one configuration trained as one, on `parameter_blocks`, `traced_gradients`
  with `recorded_operations`, and `early_updates`.
* `memory`: settings of a training process.
* `seed_runs`: runs on disk, their checkpoints, resuming.
* `seed_training`: the loop, spread over `processes`.
* `separate_training`, `memory_dataset`: other policies, in LeRobot's own loop, with their frames in memory.
"""

from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.seed_training import train_seeds

__all__ = ["SeedsTrainConfig", "train_seeds"]
