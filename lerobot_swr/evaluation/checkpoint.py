"""Loads any LeRobot checkpoint, and the dataset that it is compared with."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import OBS_STATE

from lerobot_swr.trajectories import Trajectories, load_trajectories


@dataclass
class DatasetSource:
    """A dataset on this machine or on the Hub."""

    # Folder of the dataset; null looks it up (or downloads it) by repo_id, as LeRobot does.
    root: Path | None = None
    repo_id: str | None = None
    # Only these episodes are the reference; null takes all.
    episodes: list[int] | None = None

    def metadata(self) -> LeRobotDatasetMetadata:
        """Metadata of the dataset, whose low-dimensional data are then on this machine.

        Raises:
            ValueError: If neither `root` nor `repo_id` is given, or an episode does not exist.
            FileNotFoundError: If `root` holds no dataset.
        """
        if self.root is None and self.repo_id is None:
            raise ValueError("dataset.root is missing: give the folder of the training dataset")
        if self.root is not None and not (self.root / "meta" / "info.json").is_file():
            raise FileNotFoundError(
                f"dataset.root={str(self.root)!r}: no LeRobot dataset there (no meta/info.json); "
                "check the path, or make one with lerobot-swr-dataset"
            )
        if self.root is not None:
            meta = LeRobotDatasetMetadata(self.repo_id or f"local/{self.root.name}", root=self.root)
        else:
            meta = LeRobotDataset(self.repo_id, download_videos=False).meta
        if self.episodes is not None and not self.episodes:
            raise ValueError("dataset.episodes=[]: no episode is left to compare with; leave it out for all")
        beyond = [episode for episode in self.episodes or [] if not 0 <= episode < meta.total_episodes]
        if beyond:
            raise ValueError(
                f"dataset.episodes={self.episodes}: episodes {beyond} do not exist; "
                f"the dataset has episodes 0 to {meta.total_episodes - 1}"
            )
        return meta


@dataclass
class Checkpoint:
    """A trained policy, ready to act.

    Attributes:
        policy: In evaluation mode; a LeRobot policy, or what acts like one.
        preprocessor: Observations to the policy's inputs.
        postprocessor: The policy's outputs to actions.
    """

    policy: Any
    preprocessor: Any
    postprocessor: Any

    @property
    def has_styles(self) -> bool:
        """Whether the policy is conditioned on styles."""
        return hasattr(self.policy, "styles")


def load_checkpoint(config: PreTrainedConfig, rename_map: dict[str, str] | None = None) -> Checkpoint:
    """Load the policy at ``config.pretrained_path``.

    Raises:
        FileNotFoundError: If there is no checkpoint.
        ValueError: If it is damaged.
    """
    path = Path(str(config.pretrained_path))
    if path.is_dir() and not (path / "model.safetensors").is_file():
        raise FileNotFoundError(f"policy.path={str(path)!r}: no model.safetensors in this folder")
    policy = get_policy_class(config.type).from_pretrained(
        pretrained_name_or_path=path, config=config, revision=config.pretrained_revision
    )
    policy.eval()
    preprocessor, postprocessor = make_pre_post_processors(
        policy_cfg=config,
        pretrained_path=str(path),
        pretrained_revision=config.pretrained_revision,
        preprocessor_overrides={
            "device_processor": {"device": str(policy.config.device)},
            "rename_observations_processor": {"rename_map": rename_map or {}},
        },
    )
    return Checkpoint(policy, preprocessor, postprocessor)


def load_demonstrations(meta: LeRobotDatasetMetadata) -> Trajectories:
    """A dataset's observations and actions, without pictures."""
    return load_trajectories(meta, [key for key, ft in meta.features.items() if _is_low_dimensional(key, ft)])


def load_reference(source: DatasetSource, checkpoint: Checkpoint) -> Trajectories:
    """The demonstrations that a checkpoint is compared with: observations and, where present, actions.

    Raises:
        ValueError: If a style policy was trained on another dataset: its styles belong to episodes that are
            not in this one.
    """
    meta = source.metadata()
    keys = [key for key, ft in meta.features.items() if _is_low_dimensional(key, ft)]
    config = checkpoint.policy.config
    needed = [key for key, ft in config.input_features.items() if ft.type is not FeatureType.VISUAL]
    absent = [key for key in [*needed, OBS_STATE] if key not in keys]
    if absent:
        raise ValueError(
            f"dataset.root={str(meta.root)!r} lacks {absent}, which the policy looks at; it has {keys}"
        )
    trajectories = load_demonstrations(meta)
    known = getattr(config, "dataset_fingerprint", None)
    if checkpoint.has_styles and known is not None:
        if len(trajectories) != config.num_episodes:
            raise ValueError(
                f"dataset.root={str(meta.root)!r} has {len(trajectories)} episodes, but the checkpoint has "
                f"styles of {config.num_episodes}; give the dataset that it was trained on"
            )
        if trajectories.fingerprint([OBS_STATE]) != known:
            raise ValueError(
                f"dataset.root={str(meta.root)!r} is not the dataset that the checkpoint was trained on (its "
                "states differ); give that one, so that styles and episodes belong together"
            )
    return trajectories


def _is_low_dimensional(key: str, feature: dict) -> bool:
    return (key.startswith("observation.") or key == "action") and feature["dtype"].startswith(
        ("float", "int")
    )
