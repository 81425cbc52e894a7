"""Where in a LeRobot policy a style goes: which observation it extends, found by trying."""

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature, PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.constants import OBS_ENV_STATE, OBS_STATE
from lerobot.utils.random_utils import get_rng_state, set_rng_state
from torch import Tensor

from lerobot_swr.policies.backbones.source_reading import turns_state_into_text
from lerobot_swr.policies.backbones.style_probe import Preprocessor, why_style_is_not_read

AUTO = "auto"
# Places by their names, in the order in which they are tried.
PLACES = {"environment_state": OBS_ENV_STATE, "state": OBS_STATE}
TYPES = {OBS_ENV_STATE: FeatureType.ENV, OBS_STATE: FeatureType.STATE}
# What policies raise at features that they do not know what to do with.
MISFITS = (ValueError, RuntimeError, LookupError, TypeError, AttributeError, AssertionError, ArithmeticError)

Batch = dict[str, Tensor]


@dataclass(frozen=True)
class StylePlace:
    """The observation whose last numbers are the style, after normalisation.

    Attributes:
        name: ``environment_state`` or ``state``.
        style_dim: Dimension of a style.
        extends: Whether the dataset has that observation; else the style is all of it.
    """

    name: str
    style_dim: int
    extends: bool

    @property
    def key(self) -> str:
        """LeRobot's name of the observation."""
        return PLACES[self.name]

    def styled(self, inputs: Mapping[str, PolicyFeature]) -> dict[str, PolicyFeature]:
        """The input features with the style in its place."""
        before = inputs[self.key].shape[0] if self.extends else 0
        return {**inputs, self.key: PolicyFeature(TYPES[self.key], (before + self.style_dim,))}

    def put(self, batch: Batch, style: Tensor) -> Batch:
        """A batch with styles (B, style_dim), the same for all observations of a window; `batch` stays."""
        state = batch[OBS_STATE]  # (B, d) or (B, T, d)
        style = style.to(state.dtype)
        if state.ndim > 2:
            style = style.unsqueeze(1).expand(-1, state.shape[1], -1)
        seen = torch.cat([batch[self.key], style], dim=-1) if self.extends else style
        return {**batch, self.key: seen}

    def rewrite(self, queues: Any, style: Tensor) -> None:
        """Put other styles into the observations that a policy remembers: a chunk has one style.

        Args:
            queues: What LeRobot's policies keep as ``_queues``: observation to its last values; or None.
            style: (B, style_dim).
        """
        history = queues.get(self.key, []) if isinstance(queues, Mapping) else []
        for place, seen in enumerate(history):
            history[place] = torch.cat([seen[..., : -self.style_dim], style.to(seen.dtype)], dim=-1)

    def misfit(self, plain: PreTrainedConfig) -> str | None:
        """Why there is no room for a style, if so."""
        inputs = plain.input_features or {}
        if self.extends and len(inputs[self.key].shape) != 1:
            return f"{self.key} has shape {list(inputs[self.key].shape)} and is no vector"
        room = getattr(plain, "max_state_dim", None)
        if self.key == OBS_STATE and room is not None and self.extends:
            taken = inputs[self.key].shape[0]
            if taken + self.style_dim > room:
                return (
                    f"policy.style_dim={self.style_dim}: it pads {self.key} to max_state_dim={room} numbers, "
                    f"of which {taken} are taken; give --policy.style_dim of at most {room - taken}"
                )
        return None


def check_style_place(name: str) -> None:
    """Refuse unknown places.

    Raises:
        ValueError: For anything but ``auto`` and the names of `PLACES`.
    """
    if name not in (AUTO, *PLACES):
        raise ValueError(f"style_key={name!r}: expected 'auto', 'environment_state' or 'state'")


def check_takes_style(plain: PreTrainedConfig) -> None:
    """Refuse at once a policy whose network sees no numbers of the observation.

    Raises:
        ValueError: Saying why.
    """
    if turns_state_into_text(plain):
        raise ValueError(
            f"policy.backbone.type={plain.type!r} cannot take a style: its network reads neither "
            f"{OBS_ENV_STATE} nor {OBS_STATE}, which its processor turns into text or inputs of its own, and "
            "a style is numbers; use another backbone, e.g. act, diffusion or smolvla"
        )


def make_with_style(
    plain: PreTrainedConfig,
    build: Callable[[PreTrainedConfig], PreTrainedPolicy],
    wanted: str,
    style_dim: int,
    preprocessor: Preprocessor | None,
) -> tuple[StylePlace, PreTrainedPolicy]:
    """A policy that sees a style, and where.

    Args:
        plain: The policy's configuration with the dataset's features.
        build: Makes the policy of a configuration.
        wanted: The place, or ``auto``, which takes the first through which a style reaches the network.
        style_dim: Dimension of a style.
        preprocessor: The policy's, to try with; None where the place is known to work.

    Raises:
        ValueError: If the policy cannot take a style there, saying why.
    """
    reasons, errors = {}, []
    for name in PLACES if wanted == AUTO else (wanted,):
        place = StylePlace(name, style_dim, PLACES[name] in (plain.input_features or {}))
        random_state = get_rng_state()
        try:
            policy, reason = _made(plain, build, place, preprocessor)
        except MISFITS as error:
            policy, reason = None, " ".join(f"{type(error).__name__}: {error}".split())
            errors.append(reason)
        if policy is not None:
            return place, policy
        set_rng_state(random_state)  # the next attempt starts from the weights that it alone would have
        reasons[place.key] = reason
    if len(reasons) > 1 and len(set(reasons.values())) == 1 and errors:
        raise ValueError(f"policy.backbone.type={plain.type!r} cannot be made: {errors[0]}")
    told = "; ".join(f"through {key}: {reason}" for key, reason in reasons.items())
    raise ValueError(
        f"policy.backbone.type={plain.type!r} cannot take a style, {told}; use another backbone, e.g. act, "
        "diffusion or smolvla"
    )


def _made(
    plain: PreTrainedConfig,
    build: Callable[[PreTrainedConfig], PreTrainedPolicy],
    place: StylePlace,
    preprocessor: Preprocessor | None,
) -> tuple[PreTrainedPolicy | None, str | None]:
    """The policy with a style in some place, or why there is none."""
    misfit = place.misfit(plain)
    if misfit is not None:
        return None, misfit
    styled = copy.deepcopy(plain)
    styled.input_features = place.styled(plain.input_features or {})
    policy = build(styled)
    reason = None if preprocessor is None else why_style_is_not_read(policy, plain, place, preprocessor)
    return (policy, None) if reason is None else (None, reason)
