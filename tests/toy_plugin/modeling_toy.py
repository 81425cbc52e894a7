"""The policy ``toy``."""

from collections import deque

import torch
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import nn

from toy_plugin.configuration_toy import ToyConfig


class ToyPolicy(PreTrainedPolicy):
    """Changes its batch, keeps a queue, counts updates, logs, and draws noise in training."""

    config_class = ToyConfig
    name = "toy"

    def __init__(self, config: ToyConfig, **kwargs):
        super().__init__(config)
        self.layer = nn.Linear(config.robot_state_feature.shape[0], config.chunk_size * 2)
        self.updates = 0
        if config.reads == "raises":
            raise RuntimeError("no room")
        self.reset()

    def get_optim_params(self):
        """A generator."""
        return self.parameters()

    def reset(self):
        """Forget the chunk."""
        self.queue = deque()

    def update(self):
        """Count."""
        self.updates += 1

    def _chunk(self, state):
        if self.config.reads == "rounded":
            state = torch.round(state)
        elif self.config.reads == "nothing":
            state = torch.zeros_like(state)
        return self.layer(state.reshape(len(state), -1)).unflatten(1, (-1, 2))

    def forward(self, batch):
        """A mean, and what is logged."""
        error = self._chunk(batch.pop(OBS_STATE)) - batch[ACTION]
        if self.training:
            error = error + 0.01 * torch.randn_like(error)
        loss = error.square().mean()
        return loss, {"toy_error": loss.item()}

    @torch.no_grad()
    def predict_action_chunk(self, batch):
        """The chunk."""
        return self._chunk(batch[OBS_STATE])

    @torch.no_grad()
    def select_action(self, batch):
        """The next action of the chunk."""
        if not self.queue:
            self.queue.extend(self.predict_action_chunk(batch)[:, : self.config.n_action_steps].unbind(1))
        return self.queue.popleft()
