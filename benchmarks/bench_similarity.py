"""Time and memory of all distances of 1,000 episodes of about 500 steps in 14 dimensions."""

import resource
import time

import numpy as np

from lerobot_swr.similarity.distances import pairwise_distances


def main() -> None:
    rng = np.random.default_rng(0)
    states = [
        rng.normal(size=(length, 14)).astype(np.float32) for length in rng.integers(400, 501, size=1000)
    ]
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    seconds = []
    for _ in range(3):
        start = time.perf_counter()
        pairwise_distances(states)
        seconds.append(time.perf_counter() - start)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"pairwise_distances: {np.median(seconds):.2f} s (median of 3: {np.round(seconds, 2).tolist()})")
    print(f"peak memory of the process: {peak / 1e6:.2f} GB, of which {before / 1e6:.2f} GB before the call")


if __name__ == "__main__":
    main()
