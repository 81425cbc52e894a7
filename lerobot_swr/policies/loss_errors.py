"""How badly a policy imitates demonstrations under styles, by the backbone's own loss."""

from collections.abc import Sequence

import torch
from lerobot.utils.constants import ACTION
from torch import Tensor

from lerobot_swr.policies.backbones.backbone import Backbone
from lerobot_swr.styles.encoding import Frames

NUMBERS = (
    32,
    128,
    256,
)  # frames of an episode per step, in all, and rows at once, where there are no pictures
PICTURES = (8, 32, 32)  # and where there are


class LossErrors:
    """An `Imitation` by the loss of a backbone, which predicts chunks and may draw noise.

    In evaluation a backbone draws the same noise every time, so styles are compared under the same.

    Args:
        backbone: In evaluation mode.
        sees_images: Whether it looks at pictures, which take long.
    """

    def __init__(self, backbone: Backbone, sees_images: bool):
        self._backbone = backbone
        self.frames_per_step, self.frames, self._rows = PICTURES if sees_images else NUMBERS

    def objective(self, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
        """The mean over all frames and starts, in which each style has its own share."""
        n_episodes, n_styles, _ = styles.shape
        lengths = torch.tensor([len(episode[ACTION]) for episode in episodes], device=styles.device)
        owner = torch.arange(n_episodes, device=styles.device).repeat_interleave(lengths)
        batch = {key: torch.cat([e[key] for e in episodes]) for key in episodes[0]}
        batch = {key: torch.cat([value] * n_styles) for key, value in batch.items()}
        used = styles[owner].transpose(0, 1).flatten(0, 1)
        return self._backbone.loss(batch, used, torch.ones(len(used), device=used.device))[0]

    def errors(self, episodes: Sequence[Frames], styles: Tensor) -> Tensor:
        """See `Imitation`; one style of one episode after the other."""
        return torch.stack(
            [
                torch.stack([self._error(episode, style) for style in of_episode])
                for episode, of_episode in zip(episodes, styles, strict=True)
            ]
        )

    def _error(self, episode: Frames, style: Tensor) -> Tensor:
        count, total = len(episode[ACTION]), torch.zeros((), device=style.device)
        for first in range(0, count, self._rows):
            part = {key: value[first : first + self._rows] for key, value in episode.items()}
            rows = len(part[ACTION])
            ones = torch.ones(rows, device=style.device)
            total = total + self._backbone.loss(part, style.expand(rows, -1), ones)[0] * rows / count
        return total
