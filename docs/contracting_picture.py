"""Draws docs/images/contracting.png: one style's actions all over the maze, without and with corrections.

Needs the dataset and two checkpoints that were trained on it; docs/contracting.md has the commands.
"""

import argparse
from pathlib import Path

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import lerobot_swr  # noqa: F401  registers the policies
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.dynamics import MAX_STEP, move
from lerobot_swr.envs.maze2d.layouts import get_layout
from lerobot_swr.evaluation.checkpoint import Checkpoint, DatasetSource, load_checkpoint, load_reference

PICTURE = Path(__file__).parent / "images" / "contracting.png"
LAYOUT = get_layout("medium")
GRID = 23  # arrows per side
STARTS = ((0.2, 0.1), (0.35, 0.03), (0.8, 0.12), (0.1, 0.42), (0.9, 0.4), (0.15, 0.62), (0.85, 0.65))
STEPS = 120


def act(checkpoint: Checkpoint, positions: np.ndarray, episode: int) -> np.ndarray:
    """(n, 2) actions of an episode's style at (n, 2) positions."""
    policy = checkpoint.policy
    goals = np.broadcast_to(np.array(LAYOUT.goal, dtype=np.float32), positions.shape)
    raw = {OBS_STATE: positions.astype(np.float32), OBS_ENV_STATE: goals.copy()}
    batch = checkpoint.preprocessor({key: torch.from_numpy(value) for key, value in raw.items()})
    style = policy.styles.embedding(torch.full((len(positions),), episode))
    with torch.no_grad():
        return checkpoint.postprocessor(policy.predict(batch, style)).numpy()


def draw(axes: Axes, checkpoint: Checkpoint, demonstration: np.ndarray, episode: int) -> None:
    """The field of actions, the demonstration (T, 2), and walks from other places."""
    Maze2DEnvConfig(task="medium").draw_scene(axes)
    side = np.linspace(0.03, 0.97, GRID)
    x, y = (coordinate.ravel() for coordinate in np.meshgrid(side, side))
    actions = np.clip(act(checkpoint, np.stack([x, y], axis=1), episode), -1, 1)
    axes.quiver(x, y, *actions.T, color="0.55", angles="xy", scale_units="xy", scale=26, width=0.003)
    walkers = [np.array(STARTS)]
    for _ in range(STEPS):
        steps = MAX_STEP * np.clip(act(checkpoint, walkers[-1], episode), -1, 1)
        arrived = np.linalg.norm(walkers[-1] - LAYOUT.goal, axis=1) < LAYOUT.goal_radius
        walkers.append(move(walkers[-1], np.where(arrived[:, None], 0, steps), LAYOUT))
    for walk in np.stack(walkers, axis=1):
        axes.plot(*walk.T, color="tab:orange", linewidth=1.4)
        axes.plot(*walk[0], "o", color="tab:orange", markersize=4)
    axes.plot(*demonstration.T, color="tab:blue", linewidth=2.2)
    axes.set_aspect("equal")
    axes.set(xticks=[], yticks=[])


def main() -> None:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    for name in ("dataset", "plain", "corrective"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--episode", type=int, default=0)
    flags = parser.parse_args()
    figure = Figure(figsize=(9.6, 5.1), layout="constrained")
    for axes, folder in zip(figure.subplots(1, 2), (flags.plain, flags.corrective), strict=True):
        config = PreTrainedConfig.from_pretrained(folder)
        config.pretrained_path = folder
        checkpoint = load_checkpoint(config)
        trajectories = load_reference(DatasetSource(root=flags.dataset), checkpoint)
        draw(axes, checkpoint, trajectories.episode(flags.episode)[OBS_STATE], flags.episode)
        axes.set_title(f"{config.type}, corrective={config.corrective}")
    figure.suptitle("One style: its actions (grey), its demonstration (blue), walks from elsewhere (orange)")
    figure.savefig(PICTURE, dpi=110)


if __name__ == "__main__":
    main()
