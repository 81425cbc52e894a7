"""What of a checkpoint a policy takes over, given the dataset that it goes on with."""

import logging
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor, nn

from lerobot_swr.policies.configuration_swr import ZBCConfig
from lerobot_swr.policies.training_data import TrainingData
from lerobot_swr.random_streams import StepGenerator
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.filters import FilterError
from lerobot_swr.styles.selection import StyleSelection
from lerobot_swr.styles.table import TABLE_FILE, StyleTable

logger = logging.getLogger(__name__)


def with_own_draws(
    policy: nn.Module, state: dict[str, Tensor], data: TrainingData | None
) -> dict[str, Tensor]:
    """A run that starts from a checkpoint draws the numbers of its own seed; one that resumes goes on.

    Args:
        policy: The policy that is loaded.
        state: The checkpoint's tensors.
        data: The training dataset; None at inference.
    """
    own = {
        f"{name}.{key}": value
        for name, module in policy.named_modules()
        if isinstance(module, StepGenerator)
        for key, value in module.state_dict().items()
    }
    starts = data is not None and not data.run.resuming
    return {**state, **own} if starts else {**own, **state}


def check_corrective(corrective: str, state: dict[str, Tensor]) -> None:
    """Refuse to act with the corrective labels that are asked for from a checkpoint without.

    Raises:
        ValueError: If it was trained without.
    """
    if "correct.draws.seed" not in state:
        raise ValueError(
            f"policy.corrective={corrective!r}: this checkpoint was trained without corrective labels, which "
            "take effect in training alone; leave the flag out, or train with it"
        )


def with_own_styles(
    styles: StyleCookbook, state: dict[str, Tensor], data: TrainingData | None
) -> dict[str, Tensor]:
    """On another dataset keep the network and start new styles; on the same one, more may be trained.

    Args:
        styles: The cookbook of the policy that is loaded.
        state: The checkpoint's tensors.
        data: The training dataset; None at inference.
    """
    # Checkpoints of before scenes were kept say nothing of them.
    scenes = {f"styles.scenes.{key}": value for key, value in styles.scenes.state_dict().items()}
    state = {**scenes, **state}
    if data is None:
        return state
    if not data.fine_tunes:
        # Episodes that this run trains on and those that the checkpoint was trained on.
        known = state.get("styles.trained")
        if known is not None and known.shape == styles.trained.shape:
            state = {**state, "styles.trained": torch.maximum(known, styles.trained)}
        return state
    logger.warning(
        "The dataset is not the one that the checkpoint was trained on: the network is kept, %d new "
        "styles are started.",
        len(styles),
    )
    kept = {key: value for key, value in state.items() if not key.startswith("styles.")}
    return {**kept, **{f"styles.{key}": value for key, value in styles.state_dict().items()}}


def adopt_table(styles: StyleCookbook, stored: StyleTable | None, data: TrainingData | None) -> None:
    """Take the checkpoint's table, unless it describes another dataset than the policy's.

    A run that starts from a checkpoint of its own dataset keeps columns and named filters, and has those
    columns anew for which it asks (``behavior_rule``, ``style_metrics``).

    Raises:
        ValueError: If the table is not that of the checkpoint.
    """
    if data is not None and data.fine_tunes:
        if stored is not None and stored.filters:
            logger.warning(
                "Named filters of the old dataset's styles are dropped: %s", ", ".join(stored.filters)
            )
    elif stored is not None:
        if len(stored) != len(styles):
            raise ValueError(
                f"{TABLE_FILE} has {len(stored)} rows, the checkpoint {len(styles)} styles; copy the "
                "checkpoint again"
            )
        asked = styles.table
        if data is not None and not data.run.resuming and asked is not None and len(asked) == len(stored):
            styles.table = _renewed(stored, asked, cast(ZBCConfig, data.config).behavior_rule is not None)
        else:  # the run goes on, or the table has rows for episodes of other datasets
            styles.table = stored
    elif styles.table is None:
        logger.warning(
            "This checkpoint has no table of its demonstrations: filters are not available. Make it with "
            "lerobot-swr-styles CHECKPOINT --dataset.root=DATASET"
        )


def _renewed(stored: StyleTable, asked: StyleTable, has_rule: bool) -> StyleTable:
    """A checkpoint's table with the columns that a run asks for, and the named filters that still apply."""
    new = {name: values for name, values in asked.columns.items() if has_rule or name != "behavior"}
    renewed = replace(asked, columns={**asked.columns, **stored.columns, **new})
    for name, text in stored.filters.items():
        try:
            renewed = renewed.with_filter(name, text)
        except FilterError as error:
            logger.warning("The named filter %r is dropped: %s", name, error)
    return renewed


def select_styles(styles: StyleCookbook, config: ZBCConfig) -> None:
    """Draw what the configuration says, or blend; tell at once where nothing is left to draw.

    Raises:
        ValueError: If the selection is empty, or a style does not exist.
    """
    if config.style_interpolate is not None:
        i, j, share = config.style_interpolate
        styles.interpolate(int(i), int(j), share)
    elif config.style_selection != StyleSelection(neighbours=config.style_selection.neighbours):
        styles.allowed()
