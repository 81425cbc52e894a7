"""Makes the strips of rendered frames in docs/images: python docs/d3il_pictures.py."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from lerobot_swr.demos.d3il_aligning import AligningJob
from lerobot_swr.demos.d3il_avoiding import AvoidingJob
from lerobot_swr.demos.recipe import Demonstration
from lerobot_swr.envs.d3il.aligning import AligningEnv
from lerobot_swr.envs.d3il.arm_task import ArmTask
from lerobot_swr.envs.d3il.avoiding import AvoidingEnv

IMAGES = Path(__file__).parent / "images"
FRAMES = 4
HEIGHT, WIDTH = 240, 320


def angle(quaternion: np.ndarray) -> float:
    """Turn about the vertical, in rad."""
    return 2 * float(np.arctan2(quaternion[3], quaternion[0]))


def context(demonstration: Demonstration) -> Mapping[str, list[float]]:
    """Reset options that restore the scene of an aligning demonstration."""
    scene = demonstration.observations["observation.environment_state"][0].astype(float)
    return {
        "box": [*scene[0:2], angle(scene[3:7])],
        "target": [*scene[7:9], angle(scene[10:14])],
    }


def strip(env: ArmTask, demonstration: Demonstration, options: Mapping[str, list[float]]) -> np.ndarray:
    """(HEIGHT, FRAMES * WIDTH, 3): the start, two moments in between and the end."""
    env.reset(options=dict(options))
    wanted = np.linspace(0, len(demonstration.actions) - 1, FRAMES).astype(int)
    frames = []
    for t, action in enumerate(demonstration.actions):
        if t in wanted:
            frames.append(env.render())
        env.step(action)
    return np.concatenate(frames, axis=1)


def save(name: str, *strips: np.ndarray) -> None:
    """Write strips below each other as a PNG."""
    picture = Image.fromarray(np.concatenate(strips, axis=0))
    IMAGES.mkdir(exist_ok=True)
    picture.save(IMAGES / name, optimize=True)
    print(IMAGES / name, (IMAGES / name).stat().st_size // 1000, "kB")


def main() -> None:
    """Make all pictures."""
    size = {"render_mode": "rgb_array", "render_height": HEIGHT, "render_width": WIDTH}
    avoiding, aligning = AvoidingEnv(**size), AligningEnv(**size)
    ways = AvoidingJob(("top-mid-midtop", "bottom-bottom-midbottom"), seed=3)
    save("d3il_avoiding.png", *(strip(avoiding, ways(i), {}) for i in range(2)))
    sides = AligningJob(("inside", "outside"), seed=5)
    demonstrations = [sides(i) for i in range(2)]
    save("d3il_aligning.png", *(strip(aligning, demo, context(demo)) for demo in demonstrations))


if __name__ == "__main__":
    main()
