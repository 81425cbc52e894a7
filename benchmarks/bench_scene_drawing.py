"""Time of drawing a style by scene, for one rollout, by the number of demonstrations.

The first draw, which prepares the demonstrations that are allowed, is told apart from those that follow.
"""

import time

import numpy as np
import torch

from lerobot_swr.styles.cookbook import StyleCookbook

DIMENSIONS = 14  # of the observation, all of which vary
DRAWS = 200


def main() -> None:
    torch.set_num_threads(1)
    for n in (100, 1_000, 10_000, 100_000):
        torch.manual_seed(0)
        cookbook = StyleCookbook(n, 10, 0.1, "scene", scene_dim=DIMENSIONS)
        cookbook.trained[:] = 1
        cookbook.scenes.fit(torch.randn(n, DIMENSIONS), np.ones(DIMENSIONS, dtype=bool))
        seconds = []
        for _ in range(DRAWS + 1):
            scene = torch.randn(1, DIMENSIONS)
            start = time.perf_counter()
            cookbook.draw(1, scene=scene)
            seconds.append(time.perf_counter() - start)
        first, others = 1e3 * seconds[0], 1e3 * np.array(seconds[1:])
        print(
            f"{n:7d} demonstrations: {np.median(others):.3f} ms (90 %: {np.quantile(others, 0.9):.3f}), "
            f"the first {first:.1f} ms"
        )


if __name__ == "__main__":
    main()
