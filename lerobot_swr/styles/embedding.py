"""Styles from the similarity: coordinates of what ν compares, instead of vectors that start anywhere."""

import numpy as np
import torch
from torch import Tensor, nn

from lerobot_swr.trajectories import Trajectories

REFERENCES = 4096  # demonstrations that give the directions; of more, as many are drawn
REFERENCE_NUMBERS = 2**26  # of the references together, at most
ROWS = 512  # demonstrations that are written out at once


class MannerEmbedding(nn.Module):
    """z of a demonstration: principal coordinates of its padded states: classical scaling of ν's distances.

    The first coordinate has standard deviation 1 over the demonstrations; further ones keep their proportion.

    Attributes:
        mean: (D,) buffer.
        directions: (style_dim, D) buffer, already divided by the first coordinate's standard deviation.

    Args:
        style_dim: Dimension of z.
        length: Frames to which states are padded or cut.
        width: Dimensions of a state; D is length · width.
    """

    def __init__(self, style_dim: int, length: int, width: int):
        super().__init__()
        self._length = length
        self.mean: Tensor
        self.directions: Tensor
        self.register_buffer("mean", torch.zeros(length * width))
        self.register_buffer("directions", torch.zeros(style_dim, length * width))

    def fit(self, states: np.ndarray, lengths: np.ndarray, trained: np.ndarray) -> None:
        """Find the directions.

        Args:
            states: (F, width) what ν compares, episodes one after the other.
            lengths: (N,) their numbers of frames.
            trained: (M,) the episodes that count.

        Raises:
            ValueError: If these are all alike.
        """
        from sklearn.decomposition import PCA  # late: it takes long to import

        count = min(len(trained), REFERENCES, max(2, REFERENCE_NUMBERS // self.mean.numel()))
        drawn = np.sort(np.random.default_rng(0).permutation(trained)[:count])
        vectors = self._padded(states, lengths, drawn).astype(np.float64)
        n = min(len(self.directions), *vectors.shape)
        found = PCA(n, svd_solver="full" if min(vectors.shape) <= 500 else "randomized", random_state=0)
        deviation = float(found.fit_transform(vectors)[:, 0].std())
        if not deviation > 1e-9 * max(1.0, float(np.abs(vectors).max())):
            raise ValueError(
                "style_init='similarity': all demonstrations are alike in what similarity compares; choose "
                "it with similarity_keys, similarity_frame or similarity_features, or use style_init='normal'"
            )
        self.mean.copy_(torch.from_numpy(found.mean_))
        self.directions[:n] = torch.from_numpy(found.components_ / deviation)

    def embed(self, states: np.ndarray, lengths: np.ndarray) -> Tensor:
        """(N, style_dim) styles of N demonstrations.

        Args:
            states: (F, width) what ν compares, episodes one after the other.
            lengths: (N,) their numbers of frames.
        """
        device = self.mean.device
        parts = []
        for start in range(0, len(lengths), ROWS):
            rows = np.arange(start, min(start + ROWS, len(lengths)))
            vectors = torch.from_numpy(self._padded(states, lengths, rows)).to(device)
            parts.append((vectors - self.mean) @ self.directions.T)
        return torch.cat(parts)

    def of(self, compared: Trajectories) -> Tensor:
        """(N, style_dim) styles of demonstrations, of which all columns are what ν compares."""
        return self.embed(compared.joined(list(compared.columns)), compared.lengths)

    def _padded(self, states: np.ndarray, lengths: np.ndarray, episodes: np.ndarray) -> np.ndarray:
        """(E, D) float32, the last state repeated."""
        starts = (np.cumsum(lengths) - lengths)[episodes, None]
        rows = starts + np.minimum(np.arange(self._length), lengths[episodes, None] - 1)
        return states[rows].reshape(len(episodes), -1).astype(np.float32)
