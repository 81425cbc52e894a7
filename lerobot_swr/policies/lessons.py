"""What one training step teaches: a lesson, made of a batch by lesson steps.

LeRobot's loop gives a batch of frames, each from an episode i; its sampler cannot be replaced. Which style a
frame teaches, how much it counts and which frames are replaced by corrective ones is decided here, within the
policy's `forward`: `Balance`, then `Correct` (optional), then `Relabel` (wzbc), which is algorithm 1, then
`Blur` (optional).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, Self

import numpy as np
import torch
from scipy.special import ndtri
from torch import Tensor, nn

from lerobot_swr.corrective.frames import CorrectiveStream
from lerobot_swr.frame_rows import FrameRows
from lerobot_swr.random_streams import StepGenerator
from lerobot_swr.sampling import PartnerSampler
from lerobot_swr.trajectories import Trajectories

CORRECTIVE_STREAM, NOISE_STREAM = 1, 2  # of random numbers; pairs are drawn from stream 0


@dataclass(frozen=True)
class Lesson:
    """The frames of a step, or of several steps one after the other, and what each of them teaches.

    Attributes:
        batch: Preprocessed, as LeRobot gives it: features (B, ...), ``episode_index`` (B,), ...
        weight: (B,) factor of each frame's loss.
        episode: (B,) int64, the episode whose style the frame teaches.
        teaches_style: (B,) bool, whether its gradient flows into that style, or into the network alone.
        corrective: (B,) bool, which frames are corrective labels; None without them.
        noise: (B, style_dim) what is added to the styles; None for nothing.
    """

    batch: dict[str, Any]
    weight: Tensor
    episode: Tensor
    teaches_style: Tensor
    corrective: Tensor | None = None
    noise: Tensor | None = None

    @classmethod
    def of(cls, batch: dict[str, Any]) -> Self:
        """Every frame teaches the style of its own episode, and all count alike."""
        episode = batch["episode_index"]
        ones = torch.ones(len(episode), device=episode.device)
        return cls(batch, ones, episode, ones.bool())

    def tensors(self, keys: Sequence[str]) -> dict[str, Tensor]:
        """The lesson by name, with the features `keys` of its batch."""
        own = {"weight": self.weight, "episode": self.episode, "teaches_style": self.teaches_style}
        noise = {} if self.noise is None else {"noise": self.noise}
        return {**{key: self.batch[key] for key in keys}, **own, **noise}

    @classmethod
    def of_tensors(cls, tensors: Mapping[str, Tensor]) -> Self:
        """The lesson that `tensors` gave, without what is only logged."""
        batch = dict(tensors)
        weight, episode, teaches = (batch.pop(key) for key in ("weight", "episode", "teaches_style"))
        return cls(batch, weight, episode, teaches, noise=batch.pop("noise", None))


class LessonStep(Protocol):
    """Changes what is taught. Its random draws and counts are its own; only training calls it."""

    def __call__(self, lesson: Lesson, steps: int) -> Lesson:
        """The lesson changed; `steps` are the training steps whose frames it holds, as many of each."""
        ...

    def log(self, lesson: Lesson, losses: Tensor) -> dict[str, float]:
        """Numbers to log, of a finished lesson and the (B,) weighted losses of its frames."""
        ...


class Balance:
    """Lets uniformly drawn frames count every episode alike, and a demonstrator's pauses not at all.

    Args:
        trajectories: The training dataset, F frames.
        episodes: Those that are trained on, over which all means are.
        pauses: (F,) bool, frames that are left out; None for none.
        episodes_alike: Whether episodes count alike, rather than frames.
        unseen: How many frames at each episode's end the sampler never shows.

    Attributes:
        factors: (N,) factor of the loss of each episode's frames that are no pauses: mean length / length,
            pauses and what is never shown not counted; or 1.
    """

    def __init__(
        self,
        trajectories: Trajectories,
        episodes: Sequence[int],
        pauses: np.ndarray | None,
        episodes_alike: bool,
        unseen: int = 0,
    ):
        moves = np.ones(trajectories.lengths.sum(), bool) if pauses is None else ~pauses
        counted = moves & ~trajectories.ends(unseen) if unseen else moves
        counts = torch.from_numpy(np.add.reduceat(counted, trajectories.starts, dtype=np.int64))
        lengths, chosen = counts.clamp(min=1).to(torch.float32), torch.tensor(episodes)
        self.factors = lengths[chosen].mean() / lengths if episodes_alike else torch.ones(len(lengths))
        self._of_frames: Tensor | None = None  # (F,) 0 in a pause, their mean over the episodes' frames is 1
        if pauses is not None:
            shown = (trajectories.lengths[list(episodes)] - unseen).clip(min=0)
            share = counts[chosen].sum() / shown.sum()
            self._of_frames, self._rows = torch.from_numpy(moves) / share, FrameRows(trajectories)

    def __call__(self, lesson: Lesson, steps: int) -> Lesson:
        """Weight the frames."""
        device = lesson.episode.device
        self.factors = self.factors.to(device)
        weight = self.factors[lesson.episode]
        if self._of_frames is not None:
            self._of_frames = self._of_frames.to(device)
            weight = weight * self._of_frames[self._rows(lesson.batch)]
        return replace(lesson, weight=weight)

    def log(self, lesson: Lesson, losses: Tensor) -> dict[str, float]:
        """Nothing."""
        return {}


class Correct(nn.Module):
    """Puts corrective frames in the place of the first half of every step's frames.

    Frames come in random order. Where their number is odd, the larger half is corrective every other time.
    Corrective frames do not depend on the batch: frame n is a pure function of the seed, so a resumed run
    finds the same.

    Attributes:
        draws: Source of the random numbers; its step counts the frames of all batches, two for each
            corrective frame.
        stream: The corrective frames; None where there is no dataset.
    """

    def __init__(self, stream: CorrectiveStream | None):
        super().__init__()
        self.draws = StepGenerator(CORRECTIVE_STREAM)
        self.stream = stream
        self._places: dict[Any, tuple[Tensor, Tensor]] = {}

    def forward(self, lesson: Lesson, steps: int) -> Lesson:
        """Replace the frames.

        Raises:
            RuntimeError: If the policy was created without a dataset.
        """
        if self.stream is None:
            raise RuntimeError(
                "corrective labels need the dataset to train: create the policy with dataset_meta"
            )
        first, count = int(self.draws.step), len(lesson.episode)
        self.draws.step.add_(count)  # `+=` would have the module register it anew
        device = lesson.episode.device
        places, corrective = self._half(count // steps, steps, first % 2, device)
        lesson = replace(lesson, corrective=corrective)
        if len(places) == 0:
            return lesson
        edges = (first + count // steps * np.arange(steps + 1)) // 2
        new = self.stream.frames(self.draws, int(edges[0]), int(edges[-1]), device)
        batch = {key: lesson.batch[key].index_copy(0, places, value) for key, value in new.features.items()}
        return replace(
            lesson,
            batch={**lesson.batch, **batch},
            weight=lesson.weight.index_copy(0, places, new.weight),
            episode=lesson.episode.index_copy(0, places, new.episode),
        )

    def _half(self, count: int, steps: int, first: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Which of `steps` times `count` frames are corrective: (P,) places, and (B,) True there."""
        key = (count, steps, first, device)
        if key not in self._places:
            edges = (first + count * np.arange(steps + 1)) // 2
            corrective = np.arange(count) < np.diff(edges)[:, None]  # (steps, count)
            places = np.flatnonzero(corrective)
            kept = dict(list(self._places.items())[-3:])
            value = torch.from_numpy(places).to(device), torch.from_numpy(corrective.reshape(-1)).to(device)
            self._places = {**kept, key: value}
        return self._places[key]

    def log(self, lesson: Lesson, losses: Tensor) -> dict[str, float]:
        """``corrective_loss``: corrective frames' mean weighted loss, unbiased: read its average."""
        assert lesson.corrective is not None
        corrective = lesson.corrective.cpu().numpy()
        return {"corrective_loss": float(losses.cpu().numpy() @ corrective) / (0.5 * len(corrective))}


class Relabel(nn.Module):
    """Algorithm 1: draws for every frame, corrective ones too, the pair (i, j), whose style j it teaches.

    Where j ≠ i the frame's loss is weighted by W(τ_i, τ_j), or the pair drawn by it, and no gradient flows
    into z_j.

    Attributes:
        draws: Source of the random numbers.
        sampler: Draws the pairs; None where there is no dataset.
    """

    def __init__(self, sampler: PartnerSampler | None):
        super().__init__()
        self.draws = StepGenerator()
        self.sampler = sampler

    def forward(self, lesson: Lesson, steps: int) -> Lesson:
        """Draw the pairs. The mean loss has algorithm 1's expectation.

        Raises:
            RuntimeError: If the policy was created without a dataset.
        """
        if self.sampler is None:
            raise RuntimeError("wzbc compares demonstrations to train: create the policy with dataset_meta")
        uniforms = self.draws.uniforms(steps, len(lesson.episode) // steps)
        pairs = self.sampler.draw(lesson.episode, uniforms)
        return replace(
            lesson,
            weight=lesson.weight * pairs.weights,
            episode=pairs.episodes,
            teaches_style=~pairs.relabelled,
        )

    def log(self, lesson: Lesson, losses: Tensor) -> dict[str, float]:
        """How own and relabelled frames fare.

        ``own_style_loss``: the mean squared error of frames under their own style; ``relabelled_loss``: the
        mean of W(τ_i, τ_j) times the error under another style; ``mean_weight``: the mean of W(τ_i, τ_j);
        ``effective_demos`` per style. The first three count every episode alike where the loss does, and are
        unbiased estimates, whichever way pairs are drawn: the loss is (1 - p) own_style_loss + p
        relabelled_loss. They are defined for every batch: read their averages over time. Corrective frames
        count for ``corrective_loss`` alone, pair weights included: the loss is then half of the above plus
        half of it.
        """
        assert self.sampler is not None
        p = self.sampler.p
        numbers = {"effective_demos": self.sampler.effective_demos}
        # NumPy: torch's overhead for so few numbers would be noticeable in every step.
        values, weights = losses.cpu().numpy(), lesson.weight.cpu().numpy()
        own, share = lesson.teaches_style.cpu().numpy(), float(len(values))
        relabelled = ~own
        if lesson.corrective is not None:
            demonstrated = ~lesson.corrective.cpu().numpy()
            own, relabelled, share = own & demonstrated, relabelled & demonstrated, share / 2
        if p < 1:
            numbers["own_style_loss"] = float(values @ own) / share / (1 - p)
        if p > 0:
            numbers["relabelled_loss"] = float(values @ relabelled) / share / p
            numbers["mean_weight"] = float(weights @ relabelled) / share / p
        return numbers


class Blur(nn.Module):
    """Adds normal noise to the styles, so that styles near to each other come to mean the same.

    Args:
        deviation: Standard deviation of the noise.
        style_dim: Dimension of a style.

    Attributes:
        draws: Source of the random numbers.
    """

    def __init__(self, deviation: float, style_dim: int):
        super().__init__()
        self.draws = StepGenerator(NOISE_STREAM)
        self._deviation, self._style_dim = deviation, style_dim

    def forward(self, lesson: Lesson, steps: int) -> Lesson:
        """Draw the noise."""
        count = len(lesson.episode)
        uniforms = self.draws.uniforms(steps, count // steps * self._style_dim)
        normal = ndtri(np.maximum(uniforms, 1e-9)).astype(np.float32).reshape(count, -1)
        return replace(lesson, noise=torch.from_numpy(self._deviation * normal).to(lesson.episode.device))

    def log(self, lesson: Lesson, losses: Tensor) -> dict[str, float]:
        """Nothing."""
        return {}


def logged(steps: Sequence[LessonStep], lesson: Lesson, losses: Tensor | None) -> dict[str, float]:
    """What all steps log; nothing where the losses are not known singly."""
    if losses is None:
        return {}
    return {name: value for step in steps for name, value in step.log(lesson, losses.detach()).items()}
