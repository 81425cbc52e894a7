"""Finds styles for demonstrations that were not trained on: the network is frozen, z is optimised."""

from collections.abc import Callable, Sequence

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

Frames = dict[str, Tensor]
"""Normalised observations (T, d_k) and ``action`` (T, A) of one episode."""

ENCODING_STEPS = 200
STARTS = 5  # nearest demonstrations whose styles are tried as starts


def encode_styles(
    network: Callable[[Frames, Tensor], Tensor],
    episodes: Sequence[Frames],
    starts: Tensor,
    steps: int = ENCODING_STEPS,
) -> tuple[Tensor, Tensor]:
    """The style of each episode under which the network imitates it best.

    Minimises the episode's mean squared error of the normalised action over z by Adam, from several starts at
    once; the best z met on the way is kept. Nothing is drawn at random and no parameter's gradient changes,
    so this may run in the middle of training.

    Args:
        network: π_θ(a | s, z) as a function of a batch of observations and of styles.
        episodes: E episodes of T_e frames.
        starts: (E, K, style_dim) styles to start from.
        steps: Number of Adam steps.

    Returns:
        (E, style_dim) styles and (E,) their mean squared errors.
    """
    n_episodes, n_starts, _ = starts.shape
    lengths = torch.tensor([len(episode[ACTION]) for episode in episodes], device=starts.device)
    owner = torch.arange(n_episodes, device=starts.device).repeat_interleave(lengths).repeat(n_starts)
    start = torch.arange(n_starts, device=starts.device).repeat_interleave(int(lengths.sum()))
    place = owner * n_starts + start  # (frames * K,) row of the flattened styles
    keys = [key for key in episodes[0] if isinstance(episodes[0][key], Tensor)]
    batch = {key: torch.cat([e[key] for e in episodes]).repeat(n_starts, 1) for key in keys}

    def errors(styles: Tensor) -> Tensor:
        """(E * K,) mean squared errors of as many styles."""
        squared = (network(batch, styles[place]) - batch[ACTION]).square().mean(dim=-1)
        total = torch.zeros(len(styles), device=styles.device).index_add(0, place, squared)
        return total / lengths.repeat_interleave(n_starts)

    best = starts.flatten(0, 1).clone()
    with torch.no_grad():
        best_error = errors(best)
    with torch.enable_grad():
        styles = best.clone().requires_grad_()
        # Steps of a tenth of the styles' spread: far enough to reach any style, small enough to settle.
        rate = 0.1 * max(float(best.square().mean().sqrt()), 1e-3)
        optimizer = torch.optim.Adam([styles], lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in range(steps):
            error = errors(styles)
            improved = error.detach() < best_error
            best = torch.where(improved[:, None], styles.detach(), best)
            best_error = torch.where(improved, error.detach(), best_error)
            (styles.grad,) = torch.autograd.grad(error.sum(), [styles])
            optimizer.step()
            schedule.step()
    chosen = best_error.view(n_episodes, n_starts).argmin(dim=1)
    rows = torch.arange(n_episodes, device=chosen.device) * n_starts + chosen
    return best[rows], best_error[rows]
