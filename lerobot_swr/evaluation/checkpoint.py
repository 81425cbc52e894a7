"""Loads any LeRobot checkpoint, and the dataset that it is compared with."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot.configs import FeatureType, PreTrainedConfig
from lerobot.datasets import LeRobotDataset, LeRobotDatasetMetadata
from lerobot.envs import EnvConfig
from lerobot.envs.utils import env_to_policy_features
from lerobot.policies import make_pre_post_processors
from lerobot.policies.factory import get_policy_class
from lerobot.utils.constants import ACTION, HF_LEROBOT_HOME, OBS_PREFIX, OBS_STATE

from lerobot_swr.dataset_checks import Shapes, check_dimensions, check_format, describe_features
from lerobot_swr.dataset_files import is_numeric
from lerobot_swr.envs.observed import SIMULATOR, as_simulated
from lerobot_swr.trajectories import Trajectories, dimension_names, load_trajectories


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
            ValueError: If neither `root` nor `repo_id` is given, an episode does not exist, or this LeRobot
                does not read the dataset's format.
            FileNotFoundError: If `root` holds no dataset.
        """
        if self.root is None and self.repo_id is None:
            raise ValueError("dataset.root is missing: give the folder of the training dataset")
        if self.root is not None and not (self.root / "meta" / "info.json").is_file():
            raise FileNotFoundError(
                f"dataset.root={str(self.root)!r}: no LeRobot dataset there (no meta/info.json); "
                "check the path, or make one with lerobot-swr-dataset"
            )
        check_format(self.root or HF_LEROBOT_HOME / str(self.repo_id), self.repo_id)
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
    def shapes(self) -> Shapes:
        """Low-dimensional inputs and outputs of the policy to their shapes."""
        config = self.policy.config
        features = {**config.input_features, **config.output_features}
        return {key: ft.shape for key, ft in features.items() if ft.type is not FeatureType.VISUAL}

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
    """A dataset's states and actions, and its other low-dimensional observations that are usable.

    Of data for camera policies they are the simulator's, see `in_simulation`.
    """
    return in_simulation(load_trajectories(meta, [OBS_STATE, ACTION], _low_dimensional(meta)))


def in_simulation(trajectories: Trajectories) -> Trajectories:
    """Episodes as the simulator knows them, where the policy's own observations do not tell places."""
    return replace(trajectories, columns=as_simulated(trajectories.columns))


def simulated_names(meta: LeRobotDatasetMetadata) -> dict[str, list[str]]:
    """Names of the dimensions of what `load_demonstrations` reads."""
    return as_simulated(dimension_names(meta, _low_dimensional(meta)))


def load_reference(
    source: DatasetSource, checkpoint: Checkpoint, needs_actions: bool = False
) -> Trajectories:
    """The demonstrations that a checkpoint is compared with: what it looks at, and what else is usable.

    Args:
        source: The dataset.
        checkpoint: The policy.
        needs_actions: Whether actions have to be there.

    Raises:
        ValueError: If a style policy was trained on another dataset, whose episodes its styles belong to, or
            the dataset lacks what the policy looks at, or has it in other dimensions.
    """
    meta = source.metadata()
    where, config = f"dataset.root={str(meta.root)!r}", checkpoint.policy.config
    policy = checkpoint.shapes
    found = _low_dimensional(meta)
    needed = [key for key in policy if key != ACTION or needs_actions]
    absent = [key for key in dict.fromkeys([*needed, OBS_STATE]) if key not in found]
    if absent:
        has = describe_features(meta.features)
        raise ValueError(f"{where} lacks {', '.join(absent)}, which the policy looks at; it has: {has}")
    shapes = {key: ft["shape"] for key, ft in meta.features.items()}
    check_dimensions(where, shapes, policy, "give the dataset that it was trained on")
    trajectories = load_trajectories(meta, list(dict.fromkeys([*needed, OBS_STATE])), found)
    known = getattr(config, "dataset_fingerprint", None)
    if checkpoint.has_styles and known is not None:
        if len(trajectories) != config.num_episodes:
            raise ValueError(
                f"{where} has {len(trajectories)} episodes, but the checkpoint has styles of "
                f"{config.num_episodes}; give the dataset that it was trained on"
            )
        if trajectories.fingerprint([OBS_STATE]) != known:
            raise ValueError(
                f"{where} is not the dataset that the checkpoint was trained on (its states differ); give "
                "that one, so that styles and episodes belong together"
            )
    return trajectories


def check_environment(env_cfg: EnvConfig, shapes: Shapes, rename_map: dict[str, str], owner: str) -> None:
    """Refuse an environment whose features have other dimensions than those of a policy.

    Args:
        env_cfg: The environment.
        shapes: Feature to shape, as the policy has it.
        rename_map: Observation to the policy's name of it.
        owner: What the shapes belong to.

    Raises:
        ValueError: Naming the feature and both shapes.
    """
    given = {rename_map.get(key, key): ft for key, ft in env_to_policy_features(env_cfg).items()}
    check_dimensions(
        f"env.type={env_cfg.type!r}, env.task={env_cfg.task!r}",
        {key: ft.shape for key, ft in given.items() if ft.type is not FeatureType.VISUAL},
        shapes,
        "choose the environment that belongs to it",
        owner,
    )


def _low_dimensional(meta: LeRobotDatasetMetadata) -> list[str]:
    """Names of the observations and actions that are numbers."""
    return [
        key
        for key, ft in meta.features.items()
        if (key.startswith((OBS_PREFIX, SIMULATOR)) or key == ACTION) and is_numeric(ft)
    ]
