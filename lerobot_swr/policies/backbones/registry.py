"""The backbones to choose from: ``--policy.backbone.type=…``, with the options of each beside it."""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import draccus

from lerobot_swr.policies.backbones.backbone import Backbone

DEFAULT = "mlp"


@dataclass
class BackboneConfig(draccus.ChoiceRegistry):
    """Options of a backbone; a subclass registers itself with `register_subclass`."""

    # Whether many policies can be trained as one: the loss draws nothing at random, sees the observations of
    # `make` alone, and `torch.vmap` takes it.
    is_stackable: ClassVar[bool] = False

    @classmethod
    def default_choice_name(cls) -> str:
        """The type where options are given without one."""
        return DEFAULT

    @property
    def type(self) -> str:
        """The name by which the backbone is chosen."""
        return self.get_choice_name(self.__class__)

    @abstractmethod
    def make(self, observations: Mapping[str, int], style_dim: int, action_dim: int) -> Backbone:
        """A new backbone.

        Args:
            observations: Names of the observations to their dimensions, in order.
            style_dim: Dimension of a style; 0 for a policy without styles.
            action_dim: A.
        """
