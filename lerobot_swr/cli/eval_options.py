"""The options of ``lerobot-swr-eval``, checked before anything is loaded."""

import datetime as dt
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig

import lerobot_swr.evaluation.checks  # noqa: F401  (registers them)
from lerobot_swr.behavior_rules import load_behavior_rule
from lerobot_swr.configuration import check_checkpoint_path
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.evaluation.checks.behaviors import BehaviorsCheck
from lerobot_swr.evaluation.checks.check import ROLLOUTS, Check
from lerobot_swr.evaluation.checks.offline import OfflineCheck
from lerobot_swr.evaluation.checks.replay import ReplayCheck
from lerobot_swr.evaluation.rollouts import RolloutOptions
from lerobot_swr.evaluation.scenes import check_scenes

FORMER = {
    "robustness": "--check.type=robustness",
    "counterfactual": "--check.type=counterfactual --check.starts=40",
    "blend": "--check.type=blend --check.pairs=40",
    "length_band": "--check.type=length --check.band=[70,80]",
}
"""Flags of version 0.1 and what they became."""


@dataclass
class EvalCommand(RolloutOptions):
    """Options of ``lerobot-swr-eval``."""

    # What to find out: --check.type=behaviors, robustness, counterfactual, blend, offline, length or replay,
    # each with options of its own. null: behaviors, or offline where no environment is given.
    check: Check | None = None
    # The demonstrations to compare with (the training dataset, for a style policy).
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Environment for rollouts; leave it out to evaluate on the dataset's frames.
    env: EnvConfig | None = None
    # Give the checkpoint as --policy.path=FOLDER; other --policy.* flags override its configuration.
    policy: PreTrainedConfig | None = None
    # Instead of a policy: "playback" plays demonstrations of the dataset back with feedback; "replay" is
    # short for --check.type=replay.
    baseline: str | None = None
    # Labels episodes: module:function, or behaviors.json (lerobot-swr-behaviors finds it); null takes the
    # environment's own rule.
    behavior_rule: str | None = None
    # Where results are written; null makes a folder under outputs/swr_eval.
    output_dir: Path | None = None
    # Rename observations of the environment to the policy's names.
    rename_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Load the checkpoint's configuration and check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        super().__post_init__()
        check = self._find_check()
        self._refuse_what_has_no_effect(check)
        self._check_rule_file()
        if self.scenes is not None and self.env is not None:
            check_scenes(self.scenes, self.env)
        if self.env is not None and (self.recorded_starts or check.actor == "none"):
            task_of(self.env).start_rule()  # refuses environments that have none
        if not _overrides("style_sampling"):
            self.style_sampling = self.style_sampling or check.style_sampling
        if check.actor != "none" and self.baseline is None:
            self._find_policy()
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

    def _find_check(self) -> Check:
        """The check, and whether its actor is there."""
        if self.baseline not in (None, "playback", "replay"):
            raise ValueError(f"baseline={self.baseline!r}: expected 'playback' or 'replay'")
        if self.check is None:
            self.check = self._default_check()
        check, named = self.check, f"check.type={self.check.type!r}"
        if self.baseline == "replay" and check.actor != "none":
            raise ValueError(f"baseline='replay' is check.type='replay', not {named}: leave out one of them")
        if self.baseline == "playback" and check.actor != "any":
            raise ValueError(
                f"baseline='playback' takes the place of a policy in an environment, which {named} does not "
                "allow: leave it out, or choose another check"
            )
        if self.env is None and check.needs_env:
            raise ValueError(f"{named} acts in an environment: name one with --env.type=...")
        if self.env is not None and not check.needs_env:
            raise ValueError(f"{named} looks at the dataset's frames: leave out --env.type")
        policy = self.policy is not None or parser.get_path_arg("policy") or _policy_overrides()
        if policy and (self.baseline is not None or check.actor == "none"):
            instead = f"baseline={self.baseline!r}" if self.baseline else named
            raise ValueError(f"{instead} takes the place of a policy: leave out --policy.path and --policy.*")
        return check

    def _default_check(self) -> Check:
        if self.baseline == "replay":
            return ReplayCheck()
        if self.env is not None or self.baseline is not None:
            return BehaviorsCheck()
        return OfflineCheck()

    def _refuse_what_has_no_effect(self, check: Check) -> None:
        """Refuse options that a check does not heed."""
        if self.style_sampling is not None and _overrides("style_sampling"):
            raise ValueError(
                "--style_sampling and --policy.style_sampling say the same: leave out one of them"
            )
        heeded, given = set(check.heeds), self._given([*ROLLOUTS, "scenes", "behavior_rule"])
        given += ["dataset.episodes"] * (self.dataset.episodes is not None)
        given += ["rename_map"] * bool(self.rename_map)
        given += [f"policy.{key}" for key in ("style_sampling", "style_interpolate") if _overrides(key)]
        if "style_sampling" in heeded:
            heeded |= {"policy.style_sampling", "policy.style_interpolate"}
        if check.actor != "none" and self.baseline is None:
            heeded.add("rename_map")
        about = f"check.type={check.type!r}"
        if self.scenes is not None and "scenes" in heeded:  # styles and starts are then chosen
            heeded -= {"recorded_starts", "policy.style_interpolate"}
            about += f" with --scenes={self.scenes}"
        useless = [f"--{key}" for key in given if key not in heeded]
        if useless:
            raise ValueError(
                f"{', '.join(useless)}: no effect on {about}"
                + ("" if check.needs_env else "; for rollouts in an environment name one with --env.type=...")
            )

    def _given(self, keys: Iterable[str]) -> list[str]:
        """Which options are on the command line, or set to another value by a --config_path file."""
        return [
            key
            for key in sorted(keys)
            if parser.parse_arg(key) is not None or getattr(self, key) != getattr(EvalCommand, key)
        ]

    def _find_policy(self) -> None:
        path = parser.get_path_arg("policy")
        if not path:
            raise ValueError("policy.path is missing: give the checkpoint's pretrained_model folder")
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


def refuse_former_flags(arguments: Collection[str]) -> None:
    """Tell what became of flags of version 0.1.

    Args:
        arguments: As in ``sys.argv``.

    Raises:
        ValueError: Naming the flag, and what to write instead.
    """
    for argument in arguments:
        name = argument.partition("=")[0].removeprefix("--")
        if argument.startswith("--") and name in FORMER:
            raise ValueError(f"--{name} became a check: write {FORMER[name]}")


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
