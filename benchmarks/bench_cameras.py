"""What a picture costs on one core: the maze's own camera, and MuJoCo's of the arm (processor time)."""

import time
from collections.abc import Callable

import numpy as np

from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.camera import MazeCamera
from lerobot_swr.envs.maze2d.layouts import LAYOUTS
from lerobot_swr.envs.maze2d.scenes import draw_scene

AGENTS = 100
ARM_STEPS = 20


def milliseconds(call: Callable[[], object], frames: int) -> float:
    before = time.process_time()
    call()
    return 1e3 * (time.process_time() - before) / frames


def main() -> None:
    rng = np.random.default_rng(0)
    layout = LAYOUTS["scenes_large"]
    scenes = np.stack([draw_scene(layout, rng) for _ in range(AGENTS)])
    positions = rng.uniform(0, 1, (AGENTS, 2))
    for size in (64, 96):
        camera = MazeCamera(layout, size)
        first = milliseconds(lambda c=camera: c.pictures(positions, scenes), AGENTS)  # type: ignore[misc]
        again = min(milliseconds(lambda c=camera: c.pictures(positions, scenes), AGENTS) for _ in range(5))  # type: ignore[misc]
        print(f"maze {size} x {size}: {again:.3f} ms a frame, the first one of a scene {first:.3f} ms")
    for task in ("avoiding", "aligning"):
        costs = {}
        for obs_type in ("state", "both"):
            env = D3ILEnvConfig(task=task, obs_type=obs_type).create_rollout_env(1)
            env.reset(seed=[0])
            action = np.zeros(env.action_space.shape, dtype=np.float32)
            env.step(action)  # compiles the controller

            def steps(env=env, action=action) -> None:
                for _ in range(ARM_STEPS):
                    env.step(action)

            costs[obs_type] = milliseconds(steps, ARM_STEPS)
            env.close()
        print(f"{task} 96 x 96: a step {costs['state']:.2f} ms, with a picture {costs['both']:.2f} ms")


if __name__ == "__main__":
    main()
