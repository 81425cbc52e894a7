"""Finds styles for demonstrations that were not trained on: the network is frozen, z is optimised."""

from collections.abc import Callable, Sequence
from typing import Protocol, runtime_checkable

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

Frames = dict[str, Tensor]
"""Normalised observations (T, ...) and ``action`` (T, ...) of one episode."""

Network = Callable[[Frames, Tensor], Tensor]
"""π_θ(a | s, z): actions (B, A) of a batch of observations and of styles (B, style_dim)."""

ENCODING_STEPS = 200
STARTS = 5  # nearest demonstrations whose styles are tried as starts
FRAMES_PER_STEP = 128  # of each episode, evenly spread
FRAMES = 1024  # of each episode that count at all, evenly spread
ROWS = 8192  # frames times starts that the network sees at once where no gradient is needed


@runtime_checkable
class Imitation(Protocol):
    """How badly episodes are imitated under styles; fixed numbers, whatever is drawn at random elsewhere.

    Attributes:
        frames_per_step: Of each episode that a step looks at.
        frames: Of each episode that count at all.
    """

    frames_per_step: int
    frames: int

    def objective(self, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
        """A scalar whose gradient into each of the (E, K, style_dim) styles is that of its own error."""
        ...

    def errors(self, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
        """(E, K) errors of episodes under their (E, K, style_dim) styles, without gradient."""
        ...


class ActionErrors:
    """The mean squared error of the present action."""

    def __init__(self, network: Network):
        self.network = network
        self.frames_per_step, self.frames = FRAMES_PER_STEP, FRAMES

    def objective(self, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
        """The sum of the errors."""
        return _errors(self.network, episodes, styles).sum()

    def errors(self, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
        """See `Imitation`."""
        return _errors_of_all(self.network, episodes, styles)


def encode_styles(
    network: Network | Imitation,
    episodes: Sequence[Frames],
    starts: Tensor,
    steps: int = ENCODING_STEPS,
    on_step: Callable[[], object] = lambda: None,
) -> tuple[Tensor, Tensor]:
    """The style of each episode under which it is imitated best.

    Minimises the episode's error over z by Adam, from several starts at once; the best of the ends and the
    starts is kept. Nothing is drawn at random and no parameter's gradient changes, so this may run in the
    middle of training.

    An episode counts with at most `Imitation.frames` frames, evenly spread over it. A step looks at up to
    `Imitation.frames_per_step` of these, evenly spread and other ones than the step before, so that time and
    memory do not grow with the episode's length.

    Args:
        network: π_θ(a | s, z), whose error is the mean squared error of the normalised action; or another
            error.
        episodes: E episodes of T_e frames.
        starts: (E, K, style_dim) styles to start from.
        steps: Number of Adam steps.
        on_step: Called after each step, for a progress bar.

    Returns:
        (E, style_dim) styles and (E,) their errors.
    """
    imitation = network if isinstance(network, Imitation) else ActionErrors(network)
    thinned = [_evenly(episode, imitation.frames) for episode in episodes]
    with torch.no_grad():
        best, best_error = starts, imitation.errors(thinned, starts)
    with torch.enable_grad():
        styles = starts.clone().requires_grad_()
        # Steps of a tenth of the styles' spread: far enough to reach any style, small enough to settle.
        rate = 0.1 * max(float(starts.square().mean().sqrt()), 1e-3)
        optimizer = torch.optim.Adam([styles], lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(1, steps))
        for step in range(steps):
            parts = [_part(episode, step, imitation.frames_per_step) for episode in thinned]
            (styles.grad,) = torch.autograd.grad(imitation.objective(parts, styles), [styles])
            optimizer.step()
            schedule.step()
            on_step()
    if steps:
        ends = styles.detach()
        with torch.no_grad():
            error = imitation.errors(thinned, ends)
        improved = error < best_error
        best = torch.where(improved[..., None], ends, best)
        best_error = torch.where(improved, error, best_error)
    chosen = best_error.argmin(dim=1)
    rows = torch.arange(len(episodes), device=chosen.device)
    return best[rows, chosen], best_error[rows, chosen]


def _evenly(episode: Frames, count: int) -> Frames:
    """At most `count` frames of an episode, evenly spread from the first to the last."""
    length = len(episode[ACTION])
    if length <= count:
        return episode
    rows = torch.linspace(0, length - 1, count, dtype=torch.float64).round().long()
    return {key: value[rows.to(value.device)] for key, value in episode.items() if isinstance(value, Tensor)}


def _part(episode: Frames, step: int, count: int) -> Frames:
    """The frames of an episode that a step looks at: every n-th, each step beginning one frame later."""
    stride = -(-len(episode[ACTION]) // count)
    return {
        key: value[step % stride :: stride] for key, value in episode.items() if isinstance(value, Tensor)
    }


def _errors(network: Network, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
    """(E, K) mean squared errors of episodes under their (E, K, style_dim) styles."""
    n_episodes, n_styles, _ = styles.shape
    lengths = torch.tensor([len(episode[ACTION]) for episode in episodes], device=styles.device)
    owner = torch.arange(n_episodes, device=styles.device).repeat_interleave(lengths)  # (F,)
    keys = [key for key in episodes[0] if isinstance(episodes[0][key], Tensor)]
    batch = {key: torch.cat([e[key] for e in episodes]).repeat(n_styles, 1) for key in keys}  # (K F, d)
    used = styles[owner].transpose(0, 1).flatten(0, 1)  # (K F, style_dim)
    squared = (network(batch, used) - batch[ACTION]).square().mean(dim=-1).view(n_styles, -1)
    total = torch.zeros(n_styles, n_episodes, device=styles.device).index_add(1, owner, squared)
    return total.T / lengths[:, None]


@torch.no_grad()
def _errors_of_all(network: Network, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
    """`_errors` with bounded memory."""
    total = torch.zeros(styles.shape[:2], device=styles.device)
    size = max(1, ROWS // styles.shape[1])
    for i, episode in enumerate(episodes):
        length = len(episode[ACTION])
        for start in range(0, length, size):
            part = {k: v[start : start + size] for k, v in episode.items() if isinstance(v, Tensor)}
            total[i] += _errors(network, [part], styles[i : i + 1])[0] * len(part[ACTION]) / length
    return total
