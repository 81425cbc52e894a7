"""The options of ``lerobot-swr-eval``, checked before anything is loaded."""

import datetime as dt
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig

from lerobot_swr.behaviors import load_behavior_rule
from lerobot_swr.cli.eval_conflicts import refuse_conflicts
from lerobot_swr.configuration import check_checkpoint_path
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.evaluation.scenes import check_scenes
from lerobot_swr.styles.drawing import check_style_sampling


@dataclass
class EvalCommand:
    """Options of ``lerobot-swr-eval``."""

    # The demonstrations to compare with (the training dataset, for a style policy).
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Environment for rollouts; leave it out to evaluate on the dataset's frames.
    env: EnvConfig | None = None
    # Give the checkpoint as --policy.path=FOLDER; other --policy.* flags override its configuration.
    policy: PreTrainedConfig | None = None
    # Instead of a policy: "playback" plays demonstrations of the dataset back with feedback, "replay" plays
    # every one's recorded actions from its recorded start and says whether data and environment agree.
    baseline: str | None = None
    # Number of rollouts.
    n_episodes: int = 100
    # Largest number of environments that run at once.
    batch_size: int = 100
    # How styles are drawn: uniform (the paper), stratified (each style once before any again) or fixed; null
    # keeps the checkpoint's setting.
    style_sampling: str | None = None
    # Begin rollout k where the k-th demonstration (of dataset.episodes) began, not where the environment
    # draws; with style_sampling fixed it has that demonstration's style, too.
    recorded_starts: bool = False
    # own: each rollout begins in the recorded scene of the demonstration whose style it uses; new: in a scene
    # that nobody demonstrated. Blind replay of the demonstrations is measured beside. Of tasks whose episodes
    # have scenes of their own.
    scenes: str | None = None
    # Request every demonstrated behaviour from this many starts, the same for all, instead of n_episodes
    # rollouts: confusion matrix, control accuracy, distance to the requested demonstrations. 0 does not.
    counterfactual: int = 0
    # Blend this many pairs of styles of the same behaviour, and of different ones, instead. 0 does not.
    blend: int = 0
    # Roll out n_episodes times under every perturbation of the environment instead: success, style match and
    # length error, with each style equally often.
    robustness: bool = False
    # [shortest, longest] in frames: compare the rollouts' lengths with the demonstrations' in this band.
    length_band: list[int] | None = None
    # Labels episodes: module:function, or behaviors.json (lerobot-swr-behaviors finds it); null takes the
    # environment's own rule.
    behavior_rule: str | None = None
    # Seeds the drawing of styles and the environments.
    seed: int = 1000
    # Where results are written; null makes a folder under outputs/swr_eval.
    output_dir: Path | None = None
    # Rename observations of the environment to the policy's names.
    rename_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Load the checkpoint's configuration and check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        if self.style_sampling is not None:
            check_style_sampling(self.style_sampling)
        self._refuse_conflicts()
        self._check_rule_file()
        if self.scenes is not None and self.env is not None:
            check_scenes(self.scenes, self.env)
        if self.recorded_starts and self.env is not None:
            task_of(self.env).start_rule()  # refuses environments that have none
        self._find_policy()
        if self.length_band is not None and len(self.length_band) != 2:
            raise ValueError(f"length_band={self.length_band}: expected [shortest, longest], e.g. [70,80]")
        for key in ("counterfactual", "blend"):
            if getattr(self, key) < 0:
                raise ValueError(f"{key}={getattr(self, key)}: expected a number >= 0")
        for key in ("n_episodes", "batch_size"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected at least 1")
        if self.output_dir is None:
            self.output_dir = Path("outputs/swr_eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}"

    def _check_rule_file(self) -> None:
        """See that a file of found behaviours is one, and that the results would not replace it."""
        if self.behavior_rule is None or not self.behavior_rule.endswith(".json"):
            return
        load_behavior_rule(self.behavior_rule)
        folder = Path(self.behavior_rule).resolve().parent
        if self.output_dir is not None and self.output_dir.resolve() == folder:
            raise ValueError(
                f"output_dir={str(self.output_dir)!r} holds the rule {self.behavior_rule}, which the results "
                "would replace; choose another folder"
            )

    def _refuse_conflicts(self) -> None:
        """Refuse flags of which one would have no effect beside another."""
        given = {
            "robustness": self.robustness,
            "counterfactual": self.counterfactual > 0,
            "blend": self.blend > 0,
            "length_band": self.length_band is not None,
            "recorded_starts": self.recorded_starts,
            "scenes": self.scenes is not None,
            "style_sampling": self.style_sampling is not None,
            "behavior_rule": self.behavior_rule is not None,
            "n_episodes": self._is_given("n_episodes"),
            "batch_size": self._is_given("batch_size"),
            "dataset.episodes": self.dataset.episodes is not None,
            "rename_map": bool(self.rename_map),
            "baseline": self.baseline is not None,
            "baseline=replay": self.baseline == "replay",
            "policy.style_sampling": _overrides("style_sampling"),
            "policy.style_interpolate": _overrides("style_interpolate"),
            "policy.*": self.policy is not None or bool(_policy_overrides()),
        }
        refuse_conflicts([key for key, is_given in given.items() if is_given], self.env is not None)

    def _is_given(self, key: str) -> bool:
        """Whether an option is on the command line, or a --config_path file sets it to another value."""
        return parser.parse_arg(key) is not None or getattr(self, key) != getattr(EvalCommand, key)

    def _find_policy(self) -> None:
        path = parser.get_path_arg("policy")
        if self.baseline is not None:
            if self.baseline not in ("playback", "replay"):
                raise ValueError(f"baseline={self.baseline!r}: expected 'playback' or 'replay'")
            if path:
                raise ValueError(
                    f"baseline={self.baseline!r} takes the place of a policy: leave out --policy.path"
                )
            if self.env is None or self.blend:
                raise ValueError(
                    f"baseline={self.baseline!r} has no styles to blend and acts in an environment: give "
                    "--env.type=... and leave out --blend"
                )
            if self.baseline == "replay":
                task_of(self.env).start_rule()  # refuses environments that have none
            if self.robustness:
                self.style_sampling = self.style_sampling or "stratified"
            return
        if not path:
            raise ValueError("policy.path is missing: give the checkpoint's pretrained_model folder")
        if self.robustness and not _overrides("style_sampling"):
            self.style_sampling = self.style_sampling or "stratified"
        self.policy = checkpoint_config(path)
        if self.style_sampling is not None and hasattr(self.policy, "style_sampling"):
            self.policy.style_sampling = self.style_sampling

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Keys that LeRobot's parser loads from a folder."""
        return ["policy"]


def checkpoint_config(path: str) -> PreTrainedConfig:
    """The configuration of the checkpoint at `path`, with the ``--policy.*`` options beside it.

    Raises:
        ValueError: If there is no checkpoint.
        FileNotFoundError: If there is nothing.
    """
    check_checkpoint_path(path)
    if Path(path).is_dir() and not (Path(path) / "config.json").is_file():
        raise ValueError(
            f"policy.path={path!r}: no config.json in this folder; "
            "give a checkpoint's pretrained_model folder"
        )
    config = _stored_config(path, _policy_overrides())
    config.pretrained_path = Path(path)
    return config


def _stored_config(path: str, overrides: list[str]) -> PreTrainedConfig:
    try:
        return PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
    except OSError as error:
        if Path(path).is_dir():
            raise
        raise FileNotFoundError(
            f"policy.path={path!r}: neither a folder here nor found on the Hub; check the spelling"
        ) from error


def _overrides(key: str) -> bool:
    """Whether ``--policy.<key>`` is given."""
    return any(option.partition("=")[0] == f"--{key}" for option in _policy_overrides())


def _policy_overrides() -> list[str]:
    """The ``--policy.*`` options that are given beside the checkpoint."""
    return parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
