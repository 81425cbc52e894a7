"""What a policy takes from its training dataset: which features, their data, their statistics."""

import logging
from collections.abc import Sequence

from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_PREFIX, OBS_STATE

from lerobot_swr.configuration import training_episodes
from lerobot_swr.dataset_checks import check_dimensions, check_frame_numbers, missing_feature
from lerobot_swr.dataset_files import is_numeric
from lerobot_swr.dataset_statistics import usable_statistics
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.trajectories import Trajectories, load_trajectories

logger = logging.getLogger(__name__)


def adopt_features(config: StateConfig, meta: LeRobotDatasetMetadata | None) -> None:
    """Leave in a configuration the features that a policy of numbers can use, as vectors.

    Args:
        config: The policy's configuration, changed in place.
        meta: Metadata of the training dataset; None at inference.

    Raises:
        ValueError: If the dataset lacks ``observation.state``, ``action`` or another input of the policy, or
            one has other dimensions than the checkpoint's.
    """
    inputs, outputs = dict(config.input_features or {}), dict(config.output_features or {})
    images = [key for key, ft in inputs.items() if ft.type is FeatureType.VISUAL]
    if meta is not None:
        for key, known in ((OBS_STATE, inputs), (ACTION, outputs)):
            if key not in known:
                raise ValueError(missing_feature(config.type, key, meta))
        absent = [key for key in inputs if key not in meta.features and key not in images]
        if absent:
            raise ValueError(
                f"dataset {meta.root} lacks {', '.join(absent)}, which the policy looks at; it has: "
                f"{', '.join(meta.features)}; leave it out of policy.input_features, or train a new policy"
            )
    config.validate_features()
    if images:
        logger.warning("Policy %r does not look at images; left out: %s", config.type, ", ".join(images))
    unusable = [] if meta is None else [key for key in inputs if key not in images and not _usable(key, meta)]
    if unusable:
        logger.warning(
            "Policy %r looks at numbers called observation.<name> only; left out: %s",
            config.type,
            ", ".join(unusable),
        )
    kept = {key: ft for key, ft in inputs.items() if key not in (*images, *unusable)}
    if meta is not None:
        check_dimensions(
            f"dataset {meta.root}",
            {key: ft["shape"] for key, ft in meta.features.items()},
            {key: ft.shape for key, ft in kept.items()},
            "train a new policy on this dataset",
        )
    config.input_features = kept
    config.output_features = {key: ft for key, ft in outputs.items() if key == ACTION}
    for features in (config.input_features, config.output_features):
        for key, ft in features.items():
            if key in config.dimensions:
                features[key] = PolicyFeature(ft.type, (config.dimensions[key],))


def _usable(key: str, meta: LeRobotDatasetMetadata) -> bool:
    """Whether LeRobot's batches bring a feature of the dataset, as numbers."""
    return key.startswith(OBS_PREFIX) and is_numeric(meta.features[key])


def read_training_data(
    config: StateConfig, meta: LeRobotDatasetMetadata, optional: Sequence[str] = ()
) -> Trajectories:
    """The data that LeRobot's training will show, after comparing the dataset's statistics with them.

    ``meta.stats``, by which LeRobot normalises, becomes what is fit to normalise these data with.

    Args:
        config: The policy's configuration, with the features of `adopt_features`.
        meta: Metadata of the training dataset.
        optional: Further features to read, left out where they are not usable.

    Raises:
        ValueError: If an input is no number or not finite, LeRobot would read other frames, or the statistics
            are not those of the data.
    """
    keys = list(config.dimensions)
    trajectories = load_trajectories(meta, keys, optional)
    check_frame_numbers(meta, keys, training_episodes(meta))
    features = {**(config.input_features or {}), **(config.output_features or {})}
    identity = NormalizationMode.IDENTITY
    modes = {key: config.normalization_mapping.get(features[key].type.value, identity) for key in keys}
    columns = {key: trajectories.columns[key] for key in keys}
    meta.stats = usable_statistics(meta, columns, modes, int(trajectories.lengths.max()))
    return trajectories
