"""Enlarges a cookbook by demonstrations that were not trained on."""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor, nn

from lerobot_swr.behavior_rules import dataset_behavior_rule
from lerobot_swr.progress import Progress
from lerobot_swr.similarity import Similarity, similarity_by
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.encoding import ENCODING_STEPS, STARTS, Frames, Imitation, encode_styles
from lerobot_swr.styles.filters import names_in
from lerobot_swr.styles.table import MAX_NEIGHBOURS, OUTCOME_COLUMNS, OUTCOMES, StyleTable, make_style_table
from lerobot_swr.trajectories import Trajectories
from lerobot_swr.user_functions import is_metric_file, listed, load_style_metrics

CHUNK = 8  # episodes encoded at once; bounds memory

logger = logging.getLogger(__name__)


class StyledNetwork(Protocol):
    """A style policy, as far as it is enlarged.

    Attributes:
        config: Its configuration.
        styles: Its cookbook.
    """

    config: Any
    styles: StyleCookbook

    @property
    def imitation(self) -> Imitation:
        """How badly it imitates episodes under styles."""


@dataclass(frozen=True)
class EncodedStyles:
    """What was added to a cookbook.

    Attributes:
        episodes: Numbers of the new styles in the cookbook.
        nearest: For each the trained episode nearest by ν.
        errors: Error under the new style: of the action, or the backbone's loss.
        errors_of_nearest: The same under the style of the nearest trained episode.
    """

    episodes: list[int]
    nearest: list[int]
    errors: list[float]
    errors_of_nearest: list[float]


def add_demonstrations(
    policy: StyledNetwork,
    preprocessor: Any,
    training: Trajectories,
    new: Trajectories,
    chosen: list[int] | None = None,
    robot_type: str | None = None,
    read: Callable[[int], Frames] | None = None,
) -> EncodedStyles:
    """Give demonstrations that were not trained on a style of their own; the network stays as it is.

    Episodes of the training dataset that were left out of training get the style at their own place;
    episodes of another dataset are appended, as are their rows of the table.

    Args:
        policy: The policy, changed in place.
        preprocessor: The policy's inputs of raw observations and actions.
        training: The dataset that the policy was trained on.
        new: The dataset with the new demonstrations, which has the features of the training dataset.
        chosen: Episodes of `new`; None takes all that have no style yet.
        robot_type: Of the new dataset's metadata; finds the behaviour rule of this package's datasets.
        read: The policy's inputs of an episode of `new`, where they are more than columns of numbers.

    Raises:
        ValueError: If nothing is to be added, or a column of the table cannot be computed for `new`.
    """
    config, styles = policy.config, policy.styles
    same = new.fingerprint([OBS_STATE]) == config.dataset_fingerprint
    trained = styles.trained[: len(training)].bool().cpu().numpy()
    if chosen is None:
        chosen = np.flatnonzero(~trained).tolist() if same else list(range(len(new)))
    already = [i for i in chosen if same and trained[i]]
    if already or not chosen:
        raise ValueError(
            f"add={new.name!r}: {f'episodes {already}' if already else 'all episodes'} have a style already; "
            "name the new ones with --episodes=[...], or another dataset"
        )
    added = new.subset(chosen)
    described = None if same else _described(policy, added, robot_type)

    candidates = np.flatnonzero(trained)
    both = training.followed_by(added, config.recorded_keys)
    similarity = similarity_by(both, config.manner, Path(training.name))
    rows = np.arange(len(training), len(both))  # the added ones
    ranked, _ = similarity.nearest(rows, STARTS, candidates)
    starts = styles.embedding.weight.detach()[torch.from_numpy(ranked)]  # (E, K, style_dim)
    read = read or (lambda episode: _columns(new.episode(episode), preprocessor, config))
    encoded, errors, nearest_errors, began = [], [], [], []
    projected = None
    if styles.embedded is not None and config.has_fixed_styles:
        projected = styles.embedded.of(config.manner.of(added))
    parts = [slice(i, i + CHUNK) for i in range(0, len(chosen), CHUNK)]
    with Progress(total=len(parts) * ENCODING_STEPS, desc="Encoding", unit="step") as bar:
        for part in parts:
            frames = [read(episode) for episode in chosen[part]]
            own, n_steps = (starts[part], ENCODING_STEPS) if projected is None else (projected[part, None], 0)
            found = encode_styles(policy.imitation, frames, own, n_steps, bar.update)
            began += [_first_observation(f, config.observation_keys) for f in frames]
            encoded.append(found[0])
            errors.append(found[1])
            nearest_errors.append(encode_styles(policy.imitation, frames, starts[part, :1], steps=0)[1])

    first = len(styles)
    numbers = list(chosen) if same else list(range(first, first + len(chosen)))
    if not same:
        _append_rows(policy, described, similarity, len(added))
        styles.scenes.append(torch.stack(began))
    with torch.no_grad():
        styles.embedding.weight[numbers] = torch.cat(encoded)
    styles.trained[numbers] = 1
    return EncodedStyles(
        numbers, ranked[:, 0].tolist(), torch.cat(errors).tolist(), torch.cat(nearest_errors).tolist()
    )


def _columns(episode: dict[str, np.ndarray], preprocessor: Any, config: Any) -> Frames:
    """A policy's inputs of an episode's numbers."""
    keys = [*config.observation_keys, ACTION]
    batch = preprocessor({key: torch.from_numpy(episode[key]) for key in keys})
    return {key: batch[key] for key in keys}


def _first_observation(episode: Frames, keys: Sequence[str]) -> Tensor:
    """(d,) numbers that a policy sees at an episode's first frame; of a window, the present ones."""
    first = [episode[key][0] for key in keys]
    return torch.cat([value if value.ndim == 1 else value[-1] for value in first])


def _described(policy: StyledNetwork, added: Trajectories, robot_type: str | None) -> StyleTable | None:
    """Rows of the table for new demonstrations; None where there is no table.

    Outcomes that they lack, and columns that files hold for the training dataset, are dropped from the
    policy's table, unless a named filter needs them.

    Raises:
        ValueError: If another column of the table cannot be computed.
    """
    config, table, where = policy.config, policy.styles.table, f"add={added.name!r}"
    if table is None:
        return None
    if "task" in table.columns and not added.tasks:
        added = replace(added, tasks=("",) * len(added))
    rule = dataset_behavior_rule(config.behavior_rule, robot_type)
    metrics = load_style_metrics(config.style_metrics)
    rows = make_style_table(added, np.zeros((len(added), 0)), rule, metrics)
    missing = set(table.columns) - set(rows.columns)
    droppable = OUTCOME_COLUMNS if not any(map(is_metric_file, listed(config.style_metrics))) else missing
    if missing - droppable:
        raise ValueError(
            f"{where}: the columns {sorted(missing - droppable)} of the checkpoint's table cannot be "
            "computed for it; name the rule or metric with --behavior_rule or --style_metrics "
            "(module:function)"
        )
    needed = [name for name, text in table.filters.items() if missing & names_in(text)]
    if needed:
        raise ValueError(
            f"{where}: the columns {sorted(missing)} of the checkpoint's table, which the named filters "
            f"{needed} look at, cannot be computed for it: it has no usable {' and '.join(OUTCOMES)}, or a "
            "file holds them; --forget the filters first, or add the feature"
        )
    if missing:
        logger.warning("%s: columns of the table that cannot be computed are dropped: %s", where, missing)
        policy.styles.table = table.without_columns(missing)
    return rows


def _append_rows(
    policy: StyledNetwork, described: StyleTable | None, similarity: Similarity, n_added: int
) -> None:
    """Make room for new styles in the cookbook and describe them in the table."""
    config, styles = policy.config, policy.styles
    first = len(styles)
    if styles.table is not None and described is not None:
        n_training = len(similarity) - n_added
        everyone = np.arange(len(similarity))
        nearest, _ = similarity.nearest(everyone[n_training:], MAX_NEIGHBOURS, everyone)
        # Rows of the new demonstrations start at `first`, those of the training dataset at 0.
        numbers = np.concatenate([everyone[:n_training], first + np.arange(n_added)])
        styles.table = styles.table.extended(replace(described, neighbours=numbers[nearest]))
    enlarged = nn.Embedding(first + n_added, config.style_dim, device=styles.embedding.weight.device)
    with torch.no_grad():
        enlarged.weight[:first] = styles.embedding.weight
    styles.embedding = enlarged
    styles.trained = torch.cat([styles.trained, styles.trained.new_zeros(n_added)])
    config.num_added_styles += n_added
