"""Policies that reproduce and let you steer the diversity of demonstrations, inside LeRobot.

Reading order, along the way data takes:

* `lerobot_swr.envs`: the simulated tasks (mazes, ...).
* `lerobot_swr.demos`: scripted demonstrators and the recipes that write LeRobot datasets.
* `lerobot_swr.dataset_files`, `lerobot_swr.trajectories`: episodes of a dataset as arrays, read as LeRobot
  reads them; `lerobot_swr.dataset_checks`, `lerobot_swr.dataset_statistics`: what is asked of them.
* `lerobot_swr.similarity`, `lerobot_swr.sampling`, `lerobot_swr.styles`: the method.
* `lerobot_swr.policies`: BC, ZBC and WZBC as LeRobot policies, and the baselines BESO, DDPM-GPT, DDPM-ACT.
* `lerobot_swr.training`: many seeds at once.
* `lerobot_swr.evaluation`: rollouts, behaviours, metrics, pictures, reports; what can be checked.
* `lerobot_swr.cli`: the ``lerobot-swr-*`` commands.

Where is what:

* algorithm 1: `lerobot_swr.policies.lessons.Relabel` draws the pair (i, j), by
  `lerobot_swr.sampling.PartnerSampler`; W and ν are defined in `lerobot_swr.similarity.distances`.
* the gradient of a style: `lerobot_swr.policies.style_policy.StylePolicy._taught`, the only place where a
  style is detached or not (fixed styles get none at all: `lerobot_swr.policies.style_making`).
* a further backbone, task or check: `lerobot_swr.policies.backbones`, `lerobot_swr.envs.task`,
  `lerobot_swr.evaluation.checks`.

Importing this package registers the environment, policy and optimizer configurations with LeRobot, and
shortens one of its log messages (`lerobot_swr.ffmpeg`).
"""

import lerobot_swr.envs.d3il.configuration_d3il
import lerobot_swr.envs.maze2d.configuration_maze2d
import lerobot_swr.envs.pusht.task
import lerobot_swr.policies.baselines.configuration_baselines
import lerobot_swr.policies.configuration_swr
import lerobot_swr.policies.processor_swr  # noqa: F401
from lerobot_swr.ffmpeg import shorten_message
from lerobot_swr.version import __version__

__all__ = ["__version__"]

shorten_message()
