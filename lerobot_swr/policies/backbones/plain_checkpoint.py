"""Begins from a checkpoint of a backbone without styles: its options and weights stay."""

import logging
from collections.abc import Collection
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import hf_hub_download
from huggingface_hub.constants import SAFETENSORS_SINGLE_FILE
from lerobot.configs import PreTrainedConfig
from lerobot.policies import PreTrainedPolicy
from lerobot.utils.random_utils import get_rng_state, set_rng_state
from safetensors.torch import load_file
from torch import Tensor, nn

from lerobot_swr.policies.backbones.style_place import StylePlace

# Options of a policy that say nothing of its network.
OUTER = (
    *("input_features", "output_features", "device", "use_amp", "use_peft", "push_to_hub", "repo_id"),
    *("private", "tags", "license", "pretrained_path", "pretrained_revision"),
)

logger = logging.getLogger(__name__)


def adopt_options(backbone: PreTrainedConfig, given: Collection[str] = ()) -> None:
    """Take the options of the checkpoint at ``pretrained_path``, except those that are given.

    Args:
        backbone: The policy's configuration, changed in place. An option of it that differs from its default
            counts as given, too.
        given: Names of options that are given.

    Raises:
        ValueError: If the checkpoint is one of another policy.
        FileNotFoundError: If there is none.
    """
    where = f"policy.backbone.pretrained_path={str(backbone.pretrained_path)!r}"
    path = Path(str(backbone.pretrained_path))
    if path.parent.is_dir() and not (path / "config.json").is_file():
        raise FileNotFoundError(f"{where}: no config.json there; give a checkpoint's pretrained_model folder")
    stored = PreTrainedConfig.from_pretrained(
        str(backbone.pretrained_path), revision=backbone.pretrained_revision
    )
    if type(stored) is not type(backbone):
        more = "; a checkpoint with styles is fine-tuned with --policy.path" if _is_styled(stored) else ""
        raise ValueError(
            f"{where} is a checkpoint of {stored.type!r}, policy.backbone.type={backbone.type!r}{more}"
        )
    for option in fields(backbone):
        kept = option.name in OUTER or option.name in given
        if option.init and not kept and getattr(backbone, option.name) == _default(option):
            setattr(backbone, option.name, getattr(stored, option.name))


def _is_styled(config: PreTrainedConfig) -> bool:
    return getattr(config, "has_backbone", False)


def _default(option: Field) -> Any:
    return option.default if option.default_factory is MISSING else option.default_factory()


def load_plain_weights(
    policy: PreTrainedPolicy, options: PreTrainedConfig, place: StylePlace | None, batch: dict[str, Tensor]
) -> None:
    """Load the weights of the checkpoint at ``options.pretrained_path`` into a policy that sees a style.

    Layers that see the style have more columns than the checkpoint's: these keep their new weights, and so
    does whatever the checkpoint does not have.

    Args:
        policy: The policy, changed in place.
        options: Its configuration.
        place: Where the style goes; None without styles.
        batch: Preprocessed frames, without the style, by which the columns are found.

    Raises:
        ValueError: If a tensor does not fit.
    """
    where = f"policy.backbone.pretrained_path={str(options.pretrained_path)!r}"
    state, own = load_file(_weights_file(options), device="cpu"), policy.state_dict()
    misfits = [key for key in own if key in state and own[key].shape != state[key].shape]
    columns = {} if place is None else style_columns(policy, place, batch, misfits)
    kept, new = 0, [key for key in own if key not in state]
    with torch.no_grad():
        for key in own.keys() & state.keys():
            target, value = own[key], state[key].to(own[key])
            if key not in misfits:
                target.copy_(value)
            elif key in columns and target[:, ~columns[key]].shape == value.shape:
                target[:, ~columns[key]] = value
            elif value.shape[1:] == target.shape[1:] and len(value) < len(target):
                target[: len(value)] = value  # a table with a row for each kind of observation
            else:
                raise ValueError(
                    f"{where}: {key} has shape {list(value.shape)}, in this policy {list(target.shape)}; "
                    "give the options of the network as the checkpoint's config.json has them"
                )
            kept += 1
    if kept == 0:
        raise ValueError(
            f"{where}: has none of the policy's tensors; is it a checkpoint of {options.type!r}?"
        )
    logger.info(
        "%s: %d tensors are kept%s%s",
        where,
        kept,
        f", of which {len(misfits)} are enlarged for the style" if misfits else "",
        f"; new: {', '.join(new)}" if new else "",
    )


def _weights_file(options: PreTrainedConfig) -> str:
    path = Path(str(options.pretrained_path))
    if path.is_dir():
        return str(path / SAFETENSORS_SINGLE_FILE)
    return hf_hub_download(
        str(options.pretrained_path), SAFETENSORS_SINGLE_FILE, revision=options.pretrained_revision
    )


def style_columns(
    policy: PreTrainedPolicy, place: StylePlace, batch: dict[str, Tensor], names: list[str]
) -> dict[str, Tensor]:
    """Which inputs of some layers are the style's: those that differ where nothing but the style does.

    Args:
        policy: The policy.
        place: Where the style goes.
        batch: Preprocessed frames.
        names: Weights (O, I) of layers.

    Returns:
        Of each layer that sees the style: name of the weight to (I,) bool.
    """
    layers = {name: policy.get_submodule(name.rpartition(".")[0]) for name in names}
    seen: dict[str, list[Tensor]] = {name: [] for name in names}

    def noting(name: str) -> Any:
        def note(module: nn.Module, inputs: tuple) -> None:
            if inputs and isinstance(inputs[0], Tensor):
                seen[name].append(inputs[0].detach().reshape(-1, inputs[0].shape[-1]).clone())

        return note

    hooks = [layer.register_forward_pre_hook(noting(name)) for name, layer in layers.items()]
    random_state, training = get_rng_state(), policy.training
    style = torch.randn(len(next(iter(batch.values()))), place.style_dim)
    try:
        policy.eval()
        with torch.no_grad():
            for shift in (0.0, 1.0):
                set_rng_state(random_state)
                policy.forward(place.put(batch, (style + shift).to(next(policy.parameters()).device)))
    finally:
        for hook in hooks:
            hook.remove()
        policy.train(training)
        set_rng_state(random_state)
    found = {}
    for name, inputs in seen.items():
        if len(inputs) >= 2 and inputs[0].shape == inputs[len(inputs) // 2].shape:
            differs = (inputs[0] != inputs[len(inputs) // 2]).any(dim=0)
            if differs.any() and len(differs) == policy.state_dict()[name].shape[-1]:
                found[name] = differs
    return found
