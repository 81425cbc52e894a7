"""What a policy takes from its training dataset: which features, their data, their statistics."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import torch
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.constants import ACTION, OBS_PREFIX, OBS_STATE

from lerobot_swr.dataset_checks import check_dimensions, check_frame_numbers, missing_feature
from lerobot_swr.dataset_files import is_numeric
from lerobot_swr.dataset_statistics import usable_statistics
from lerobot_swr.pauses import pause_frames
from lerobot_swr.policies.configuration_swr import BCConfig
from lerobot_swr.policies.demonstration_frames import DemonstrationFrames, demonstration_frames
from lerobot_swr.policies.processor_swr import make_bc_pre_post_processors
from lerobot_swr.policies.state_config import StateConfig
from lerobot_swr.policies.vector_pipelines import vector_pipelines
from lerobot_swr.run_context import RunContext
from lerobot_swr.scene_variation import SceneVariation, scene_variation
from lerobot_swr.similarity import Similarity, similarity_of
from lerobot_swr.styles.encoding import Frames
from lerobot_swr.styles.table import LABELLED_BY, OUTCOMES
from lerobot_swr.trajectories import Trajectories, dimension_names, load_trajectories

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
    if images and not config.sees_images:
        logger.warning("Policy %r does not look at images; left out: %s", config.type, ", ".join(images))
    unusable = [] if meta is None else [key for key in inputs if key not in images and not _usable(key, meta)]
    if unusable:
        logger.warning(
            "Policy %r looks at numbers called observation.<name> only; left out: %s",
            config.type,
            ", ".join(unusable),
        )
    seen = images if config.sees_images else []
    kept = {key: ft for key, ft in inputs.items() if key not in (*images, *unusable) or key in seen}
    if meta is not None:
        check_dimensions(
            f"dataset {meta.root}",
            {key: ft["shape"] for key, ft in meta.features.items()},
            {key: ft.shape for key, ft in kept.items() if key not in images},
            "train a new policy on this dataset",
        )
    config.input_features = kept
    config.output_features = {key: ft for key, ft in outputs.items() if key == ACTION}
    for features in (config.input_features, config.output_features):
        for key, ft in features.items():
            if key in config.dimensions and not config.sees_images:
                features[key] = PolicyFeature(ft.type, (config.dimensions[key],))


def adopt_names(config: BCConfig, meta: LeRobotDatasetMetadata) -> None:
    """Note in a configuration the names of dimensions, where one of its options looks for things.

    Raises:
        ValueError: If names are given of a feature that is not looked at, or not as many as its dimensions.
    """
    given, dimensions = config.dimension_names or {}, config.dimensions
    for key, names in given.items():
        if len(names) != dimensions.get(key):
            known = ", ".join(f"{name} ({d})" for name, d in dimensions.items())
            raise ValueError(
                f"dimension_names={{{key}: ...}} has {len(names)} names; features and their dimensions are: "
                f"{known}"
            )
    if config.looks_for_things:
        config.dimension_names = {**dimension_names(meta, list(dimensions)), **given}


def _usable(key: str, meta: LeRobotDatasetMetadata) -> bool:
    """Whether LeRobot's batches bring a feature of the dataset, as numbers."""
    return key.startswith(OBS_PREFIX) and is_numeric(meta.features[key])


def read_training_data(
    config: StateConfig, meta: LeRobotDatasetMetadata, run: RunContext, optional: Sequence[str] = ()
) -> Trajectories:
    """The data that LeRobot's training will show, after comparing the dataset's statistics with them.

    ``meta.stats``, by which LeRobot normalises, becomes what is fit to normalise these data with.

    Args:
        config: The policy's configuration, with the features of `adopt_features`.
        meta: Metadata of the training dataset.
        run: The training run.
        optional: Further features to read, left out where they are not usable.

    Raises:
        ValueError: If an input is no number or not finite, LeRobot would read other frames, or the statistics
            are not those of the data.
    """
    keys = list(config.dimensions)
    trajectories = load_trajectories(meta, _recorded(config, meta), optional)
    check_frame_numbers(meta, keys, None if len(run.episodes) == meta.total_episodes else run.episodes)
    features = {**(config.input_features or {}), **(config.output_features or {})}
    identity = NormalizationMode.IDENTITY
    mapping = config.normalization_mapping
    modes = {key: NormalizationMode(mapping.get(features[key].type.value, identity)) for key in keys}
    columns = {key: trajectories.columns[key] for key in keys}
    meta.stats = usable_statistics(meta, columns, modes, int(trajectories.lengths.max()))
    return trajectories


def read_demonstrations(config: StateConfig, meta: LeRobotDatasetMetadata) -> Trajectories:
    """What a policy takes from a dataset that it need not train on: observations, actions, outcomes.

    Raises:
        ValueError: If a feature is missing or no numbers.
    """
    return load_trajectories(meta, _recorded(config, meta), (*OUTCOMES, *LABELLED_BY))


def _recorded(config: StateConfig, meta: LeRobotDatasetMetadata) -> list[str]:
    """The features to read.

    Raises:
        ValueError: If one over which demonstrations are to be compared is none of numbers.
    """
    keys = config.recorded_keys if isinstance(config, BCConfig) else list(config.dimensions)
    known = [key for key, feature in meta.features.items() if is_numeric(feature)]
    unknown = [key for key in keys if key not in known and key not in config.dimensions]
    if unknown:
        raise ValueError(
            f"similarity_keys={keys}: {', '.join(unknown)} are no numbers of {meta.root}, which has "
            f"{', '.join(known)}"
        )
    return keys


@dataclass(frozen=True, eq=False)
class TrainingData:
    """The dataset that a policy is created to be trained on.

    Attributes:
        config: The policy's configuration.
        meta: Metadata of the dataset.
        run: The training run.
        trajectories: All of the dataset's episodes.
        fingerprint: Hash of their states.
        from_checkpoint: Whether the network comes from a checkpoint.
        fine_tunes: Whether it comes from one that was trained on another dataset.
        pauses: (F,) bool, which frames are left out; None for none.
    """

    config: BCConfig
    meta: LeRobotDatasetMetadata
    run: RunContext
    trajectories: Trajectories
    fingerprint: str
    from_checkpoint: bool
    fine_tunes: bool
    pauses: np.ndarray | None

    @classmethod
    def read(cls, config: BCConfig, meta: LeRobotDatasetMetadata) -> Self:
        """Read the dataset; tell whether the checkpoint, if any, was trained on it.

        Args:
            config: The policy's configuration, with the features of `adopt_features`.
            meta: Metadata of the training dataset.

        Raises:
            ValueError: If the data or statistics are not usable, or a resumed run's dataset is not the
                checkpoint's.
        """
        run = RunContext.current(meta)
        trajectories = read_training_data(config, meta, run, (*OUTCOMES, *LABELLED_BY))
        fingerprint, known = trajectories.fingerprint([OBS_STATE]), config.dataset_fingerprint
        fine_tunes = known is not None and known != fingerprint
        if fine_tunes and run.resuming:
            raise ValueError(
                f"dataset.root={str(meta.root)!r} has {meta.total_episodes} episodes and is not the dataset "
                f"of the checkpoint ({config.num_episodes} episodes, fingerprint {known}); resume with the "
                "original dataset, or fine-tune on this one with --policy.path instead of --resume"
            )
        run = run.without_short(trajectories.lengths, config.unseen_frames, trajectories.name)
        # A demonstrator may wait for something that only a picture shows.
        pauses = (
            _find_pauses(trajectories, config) if config.skip_pauses and not config.image_features else None
        )
        return cls(config, meta, run, trajectories, fingerprint, known is not None, fine_tunes, pauses)

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return Path(self.meta.root)

    @cached_property
    def moving(self) -> Trajectories:
        """The episodes without the frames that are left out."""
        return self.trajectories if self.pauses is None else self.trajectories.without(self.pauses)

    @cached_property
    def compared(self) -> Trajectories:
        """What ν compares of the episodes."""
        return self.config.manner.of(self.trajectories)

    @cached_property
    def similarity(self) -> Similarity:
        """Distances of the episodes over what ν compares."""
        return similarity_of(self.compared, self.config.manner.columns, self.root)

    @cached_property
    def scene_variation(self) -> SceneVariation:
        """How much scenes differ from episode to episode."""
        names = dimension_names(self.meta, self.config.observation_keys)
        lengths, columns = self.trajectories.lengths, self.trajectories.columns
        parts = [scene_variation(columns[key], lengths, own) for key, own in names.items()]
        shares = np.concatenate([part.shares for part in parts])
        return SceneVariation(shares, tuple(name for part in parts for name in part.names))

    @property
    def first_observations(self) -> torch.Tensor:
        """(N, d) how each episode begins, as the policy sees it."""
        frames = self._prepared(self.trajectories.columns, self.trajectories.starts)
        return torch.cat([frames[key] for key in self.config.observation_keys], dim=1)

    def normalize(self, features: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """Features of numbers (F, d), raw and as the policy sees them; not all need be given."""
        dimensions = self.config.dimensions
        rows = len(next(iter(features.values())))
        blank = {key: torch.zeros(rows, d) for key, d in dimensions.items()}
        found = vector_pipelines(self.config, dimensions, self.meta.stats)[0]({**blank, **features})
        return {key: found[key] for key in features}

    def frames(self, episode: int, rows: np.ndarray) -> Frames:
        """Some frames of an episode, as batches bring them."""
        return self._source.frames(episode, rows)

    @cached_property
    def _source(self) -> DemonstrationFrames:
        preprocessor, _ = make_bc_pre_post_processors(self.config, self.meta.stats, self.meta)
        return demonstration_frames(self.config, self.meta, self.trajectories, preprocessor)

    def _prepared(self, columns: Mapping[str, np.ndarray], rows: np.ndarray) -> Frames:
        """Some rows of columns of numbers, as batches bring them."""
        preprocessor, _ = vector_pipelines(self.config, self.config.dimensions, self.meta.stats)
        keys = [*self.config.observation_keys, ACTION]
        batch = preprocessor({key: torch.from_numpy(columns[key][rows]) for key in keys})
        return {key: batch[key] for key in keys}


def _find_pauses(trajectories: Trajectories, config: BCConfig) -> np.ndarray | None:
    pauses = pause_frames(trajectories, config.observation_keys, ACTION)
    if not pauses.any():
        return None
    logger.info(
        "%.1f %% of the frames are pauses before a movement, which a policy without memory cannot "
        "learn: left out (policy.skip_pauses=false keeps them)",
        100 * pauses.mean(),
    )
    return pauses
