"""``lerobot-swr-eval``: which behaviours does a policy show, and which were demonstrated?

With an environment it rolls the policy out; without one it measures action errors on the dataset's frames.

Examples:
    lerobot-swr-eval --policy.path=outputs/train/wzbc/checkpoints/last/pretrained_model \
        --env.type=maze2d --env.task=medium --dataset.root=data/only_forward \
        --n_episodes=100 --style_sampling=stratified

    lerobot-swr-eval --policy.path=... --dataset.root=path/to/real_robot_dataset
"""

import datetime as dt
import sys
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.behaviors import BehaviorRule, load_behavior_rule
from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.envs.configuration_env import TaskEnvConfig
from lerobot_swr.evaluation.behavior_evaluation import compare, format_result, write_json
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_checkpoint, load_reference
from lerobot_swr.evaluation.offline import KINDS, format_offline, frame_errors, summarize
from lerobot_swr.evaluation.plots import plot_behaviors, plot_offline
from lerobot_swr.styles import check_style_sampling


@dataclass
class EvalCommand:
    """Options of ``lerobot-swr-eval``."""

    # The demonstrations to compare with (the training dataset, for a style policy).
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Environment for rollouts; leave it out to evaluate on the dataset's frames.
    env: EnvConfig | None = None
    # Give the checkpoint as --policy.path=FOLDER; other --policy.* flags override its configuration.
    policy: PreTrainedConfig | None = None
    # Number of rollouts.
    n_episodes: int = 100
    # Largest number of environments that run at once.
    batch_size: int = 100
    # How styles are drawn: uniform (the paper), stratified (each style once before any again) or fixed; null
    # keeps the checkpoint's setting.
    style_sampling: str | None = None
    # Labels episodes: module:function; null takes the environment's own rule.
    behavior_rule: str | None = None
    # Seeds the drawing of styles and the environments.
    seed: int = 1000
    # Where results are written; null makes a folder under outputs/swr_eval.
    output_dir: Path | None = None
    # Rename observations of the environment or dataset to the policy's names.
    rename_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Load the checkpoint's configuration and check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        path = parser.get_path_arg("policy")
        if not path:
            raise ValueError("policy.path is missing: give the checkpoint's pretrained_model folder")
        if Path(path).is_dir() and not (Path(path) / "config.json").is_file():
            raise ValueError(
                f"policy.path={path!r}: no config.json in this folder; "
                "give a checkpoint's pretrained_model folder"
            )
        overrides = parser.get_yaml_overrides("policy") + (parser.get_cli_overrides("policy") or [])
        self.policy = PreTrainedConfig.from_pretrained(path, cli_overrides=overrides)
        self.policy.pretrained_path = Path(path)
        if self.style_sampling is not None:
            check_style_sampling(self.style_sampling)
            if hasattr(self.policy, "style_sampling"):
                self.policy.style_sampling = self.style_sampling
        for key in ("n_episodes", "batch_size"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected at least 1")
        if self.output_dir is None:
            self.output_dir = Path("outputs/swr_eval") / f"{dt.datetime.now():%Y-%m-%d/%H-%M-%S}"

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Keys that LeRobot's parser loads from a folder."""
        return ["policy"]


@parser.wrap()
def evaluate(cfg: EvalCommand) -> None:
    """Evaluate a checkpoint by rollouts, or offline without an environment."""
    assert cfg.policy is not None
    assert cfg.output_dir is not None
    checkpoint = load_checkpoint(cfg.policy, cfg.rename_map)
    trajectories = load_reference(cfg.dataset, checkpoint)
    title = f"{cfg.policy.type} on {trajectories.name}"
    if cfg.env is None:
        errors = frame_errors(checkpoint, trajectories, cfg.dataset.episodes, cfg.seed)
        offline = summarize(errors)
        write_json(cfg.output_dir / "offline.json", offline, _provenance(cfg))
        per_frame = {kind: squared.mean(axis=1) for kind, squared in errors.squared.items()}
        plot_offline(cfg.output_dir / "offline.png", per_frame, errors.phase, KINDS.__getitem__, title)
        print(f"{title}\n{format_offline(offline)}\nwritten to {cfg.output_dir}")
        return

    comparison = compare(
        checkpoint,
        trajectories,
        cfg.env,
        _rule(cfg),
        n_episodes=cfg.n_episodes,
        batch_size=cfg.batch_size,
        seed=cfg.seed,
        reference_episodes=cfg.dataset.episodes,
    )
    result = comparison.result
    write_json(cfg.output_dir / "behaviors.json", result, _provenance(cfg))
    plot_behaviors(
        cfg.output_dir / "behaviors.png",
        comparison.demonstrations,
        comparison.rollouts,
        result.reference_histogram,
        result.histogram,
        cfg.env,
        f"{title}: L1 {result.l1:.3f} (floor {result.l1_floor:.3f}), success {result.success_rate:.2f}",
    )
    print(f"{title}\n{format_result(result)}\nwritten to {cfg.output_dir}")


def _rule(cfg: EvalCommand) -> BehaviorRule:
    if cfg.behavior_rule is not None:
        return load_behavior_rule(cfg.behavior_rule)
    if isinstance(cfg.env, TaskEnvConfig):
        return cfg.env.behavior_rule()
    raise ValueError(
        f"env.type={cfg.env.type!r} has no behaviour rule of its own: name one with "  # type: ignore[union-attr]
        "--behavior_rule=module:function"
    )


def _provenance(cfg: EvalCommand) -> dict[str, Any]:
    """What it takes to make a result again."""
    return {
        "command": " ".join(["lerobot-swr-eval", *sys.argv[1:]]),
        "policy_path": str(cfg.policy.pretrained_path),  # type: ignore[union-attr]
        "policy": draccus.encode(cfg.policy, PreTrainedConfig),
        "env": None if cfg.env is None else draccus.encode(cfg.env, EnvConfig),
        "dataset": draccus.encode(cfg.dataset),
        "seed": cfg.seed,
        "versions": {name: version(name) for name in ("lerobot_policy_swr", "lerobot", "torch", "numpy")},
    }


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging()
    register_third_party_plugins()
    evaluate()
