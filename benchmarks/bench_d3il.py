"""Environment steps per second of the D3IL tasks, on one core and in the threaded vector environment.

Run: python benchmarks/bench_d3il.py [--repeats 5]. The workload is what a policy causes: the reference-like
motion of 5 to 9 mm per step, with the rod pushing the box for most of the aligning steps. CPU time is printed
beside wall time, because on a shared machine only the former says what the code costs.
"""

import argparse
import time
from collections.abc import Iterator

import numpy as np

from lerobot_swr.demos.box_handler import BoxHandler
from lerobot_swr.demos.d3il_aligning import draw_habits
from lerobot_swr.demos.d3il_avoiding import draw_path, draw_set_points
from lerobot_swr.envs.d3il.aligning import AligningEnv
from lerobot_swr.envs.d3il.arm_task import ArmTask
from lerobot_swr.envs.d3il.avoiding import AvoidingEnv
from lerobot_swr.envs.d3il.behavior import AVOIDING_BEHAVIORS
from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig

TARGETS = {"avoiding": 800, "aligning": 300}


def avoiding_episodes() -> Iterator[list[np.ndarray]]:
    """Actions of one demonstration after another."""
    for i, behavior in enumerate(AVOIDING_BEHAVIORS[::3]):
        rng = np.random.default_rng(i)
        yield list(np.diff(draw_set_points(draw_path(behavior, rng), rng), axis=0))


def aligning_episodes(env: ArmTask) -> Iterator[list[np.ndarray]]:
    """Actions of a hand that pushes or pulls the box, each recorded beforehand."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        hand = BoxHandler(draw_habits(seed % 2 == 0, 0, rng), rng)
        observation, _ = env.reset(seed=seed)
        actions, over = [], False
        while not over and len(actions) < 200:
            actions.append(hand.act(observation["agent_pos"], observation["environment_state"]))
            observation, _, over, *_ = env.step(actions[-1])
        yield actions


def replay(env: ArmTask, episodes: list[list[np.ndarray]]) -> int:
    """Steps taken."""
    for seed, actions in enumerate(episodes):
        env.reset(seed=seed)
        for action in actions:
            env.step(action)
    return sum(map(len, episodes))


def one_core(task: str, env: ArmTask, episodes: list[list[np.ndarray]], repeats: int) -> None:
    replay(env, episodes[:1])  # compile
    rates = []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        n_steps = replay(env, episodes)
        rates.append((n_steps / (time.perf_counter() - wall), n_steps / (time.process_time() - cpu)))
    wall_rate, cpu_rate = np.median(rates, axis=0)
    print(
        f"{task:>9}: {wall_rate:6.0f} steps/s wall, {cpu_rate:6.0f} steps/s of CPU time per core "
        f"(median of {repeats} x {n_steps} steps; asked for: {TARGETS[task]})"
    )


def all_cores(task: str, n_envs: int) -> None:
    env = D3ILEnvConfig(task=task).create_rollout_env(n_envs)
    axes = env.single_action_space.shape[0]
    actions = np.random.default_rng(0).uniform(-0.006, 0.006, size=(60, n_envs, axes)).astype(np.float32)
    env.reset(seed=0)
    start = time.perf_counter()
    for action in actions:
        env.step(action)
    rate = actions.shape[0] * n_envs / (time.perf_counter() - start)
    env.close()
    print(f"{task:>9}: {rate:6.0f} steps/s wall in the threaded vector environment of {n_envs}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    repeats = parser.parse_args().repeats
    one_core("avoiding", AvoidingEnv(), list(avoiding_episodes()), repeats)
    aligning = AligningEnv()
    one_core("aligning", aligning, list(aligning_episodes(aligning)), repeats)
    for task in TARGETS:
        all_cores(task, n_envs=16)


if __name__ == "__main__":
    main()
