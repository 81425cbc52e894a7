"""The backbones to choose from: ``--policy.backbone.type=…``, with the options of each beside it.

They are this package's own, which register themselves here, and every policy that LeRobot knows: its own,
those of plugins and this package's baselines. What a style policy asks of either is in `traits`.
"""

import sys
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, ClassVar

import draccus
import lerobot.policies  # noqa: F401  (registers LeRobot's policies)
import numpy as np
from lerobot.configs import PreTrainedConfig, parser

from lerobot_swr.object_poses import Names
from lerobot_swr.policies.backbones.backbone import Backbone

DEFAULT = "mlp"


@dataclass
class WithoutOptions:
    """Stands in for a policy that the command line is not about."""


@dataclass
class BackboneConfig(draccus.ChoiceRegistry):
    """Options of a backbone; one of this package's own registers itself with `register_subclass`.

    Policies are looked up when they are asked for, so those that a plugin registers later count, too. A name
    that is a policy's stands for what is registered here.
    """

    # Whether many policies can be trained as one: the loss draws nothing at random, sees the observations of
    # `make` alone, and `torch.vmap` takes it, so that nothing branches on values. `Backbone.update` is not
    # called then, and `Backbone.numbers` are not logged.
    is_stackable: ClassVar[bool] = False

    @classmethod
    def get_known_choices(cls) -> dict[str, Any]:
        """Names of all backbones to the classes whose options draccus offers as flags.

        Of the policies these are the options of those that the command line is about: to offer the thousands
        of all of them, in each of ``bc``, ``zbc`` and ``wzbc``, would cost every command of LeRobot seconds.
        """
        offered = _offered([*sys.argv[1:], *parser.get_yaml_overrides("policy")])
        policies = {
            name: policy if offered is None or name in offered else WithoutOptions
            for name, policy in cls.policies().items()
        }
        return {**policies, **cls._choice_registry}

    @staticmethod
    def policies() -> dict[str, Any]:
        """Names and configurations of all policies that can be backbones."""
        known = PreTrainedConfig.get_known_choices().items()
        return {name: policy for name, policy in known if not getattr(policy, "has_backbone", False)}

    @classmethod
    def get_choice_class(cls, name: str) -> Any:
        """The configuration's class.

        Raises:
            KeyError: If there is none.
        """
        return {**cls.policies(), **cls._choice_registry}[name]

    @classmethod
    def get_choice_name(cls, subcls: type) -> str:
        """The name of a configuration's class.

        Raises:
            ValueError: If it is none of a backbone.
        """
        for name, known in {**cls.policies(), **cls._choice_registry}.items():
            if known is subcls:
                return name
        raise ValueError(f"Cannot find choice name for {subcls}")

    @classmethod
    def default_choice_name(cls) -> str:
        """The type where options are given without one."""
        return DEFAULT

    @property
    def type(self) -> str:
        """The name by which the backbone is chosen."""
        return self.get_choice_name(self.__class__)

    @property
    def looks_for_things(self) -> bool:
        """Whether it needs the names of the observations' dimensions."""
        return False

    def adopt(self, columns: Mapping[str, np.ndarray], lengths: np.ndarray, names: Names) -> None:
        """Fill in the options that the training dataset decides; none, by default.

        Args:
            columns: Feature name to raw (F, d), episodes one after the other.
            lengths: (N,) frames per episode.
            names: Of the features' dimensions.

        Raises:
            ValueError: If the dataset lacks what the options ask for.
        """

    def make_named(
        self, observations: Mapping[str, int], style_dim: int, action_dim: int, names: Names
    ) -> Backbone:
        """As `make`, for a backbone that also looks at the names of features' dimensions."""
        return self.make(observations, style_dim, action_dim)

    @abstractmethod
    def make(self, observations: Mapping[str, int], style_dim: int, action_dim: int) -> Backbone:
        """A new backbone.

        Args:
            observations: Names of the observations to their dimensions, in order.
            style_dim: Dimension of a style; 0 for a policy without styles.
            action_dim: A.
        """


def _offered(words: Sequence[str]) -> set[str] | None:
    """The types of backbones that a command line is about; None for any, if it has options and no type."""
    types, has_options = set(), False
    for word, following in pairwise([*words, ""]):
        flag, equals, value = word.partition("=")
        if not flag.startswith("--") or "backbone." not in flag:
            continue
        if flag.endswith("backbone.type"):
            types.add(value if equals else following)
        else:
            has_options = True
    return None if has_options and not types else types
