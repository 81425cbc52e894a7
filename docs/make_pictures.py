"""Draws the pictures of docs/environments.md into docs/images."""

from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

from lerobot_swr.demos.maze2d import MAZE_RECIPES
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.maze2d.layouts import get_layout
from lerobot_swr.envs.maze2d.rendering import draw_episode, draw_maze
from lerobot_swr.evaluation.plots import behavior_colors, draw_paths

IMAGES = Path(__file__).parent / "images"


def main() -> None:
    """Draw both pictures."""
    IMAGES.mkdir(exist_ok=True)
    walk = next(iter(MAZE_RECIPES[0].demonstrations(0))).observations["observation.state"]
    maze = draw_maze(get_layout("medium"), 320)
    Image.fromarray(draw_episode(maze, walk[:60])).save(IMAGES / "maze_medium.png")

    figure = Figure(figsize=(13, 3.8), layout="constrained")
    for axes, recipe in zip(figure.subplots(1, len(MAZE_RECIPES)), MAZE_RECIPES, strict=True):
        episodes = [demonstration.observations for demonstration in recipe.demonstrations(0)]
        paths = [(episode["observation.state"], recipe.behavior_rule(episode)) for episode in episodes]
        colors = behavior_colors(sorted({label for _, label in paths}))
        draw_paths(axes, paths, colors, Maze2DEnvConfig(task="medium"))
        axes.set_title(recipe.name)
    figure.savefig(IMAGES / "maze_datasets.png", dpi=100)


if __name__ == "__main__":
    main()
