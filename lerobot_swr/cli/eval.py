"""``lerobot-swr-eval``: which behaviours does a policy show, and which were demonstrated?

With an environment it rolls the policy out; without one it measures action errors on the dataset's frames.
``--check.type`` asks something else, see `lerobot_swr.evaluation.checks`.

Examples:
    lerobot-swr-eval --policy.path=outputs/train/wzbc/checkpoints/last/pretrained_model \
        --env.type=maze2d --env.task=medium --dataset.root=data/only_forward \
        --n_episodes=100 --style_sampling=stratified

    lerobot-swr-eval --policy.path=... --env.type=maze2d --dataset.root=data/only_forward \
        --check.type=counterfactual --check.starts=40

    lerobot-swr-eval --policy.path=... --dataset.root=path/to/real_robot_dataset

    lerobot-swr-eval --baseline=replay --env.type=d3il --env.task=avoiding --dataset.root=data/recorded
"""

import sys
from importlib.metadata import version
from typing import Any

import draccus
from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.behavior_rules import load_behavior_rule
from lerobot_swr.behaviors import BehaviorRule
from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.cli.eval_options import EvalCommand, refuse_former_flags
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.configuration import check_dataset_folder
from lerobot_swr.envs.task import MissingRuleError, task_of
from lerobot_swr.evaluation.checkpoint import (
    Checkpoint,
    check_environment,
    in_simulation,
    load_checkpoint,
    load_demonstrations,
    load_reference,
)
from lerobot_swr.evaluation.checks.check import Subject
from lerobot_swr.evaluation.playback import playback_checkpoint
from lerobot_swr.evaluation.results import write_json
from lerobot_swr.styles.drawing import check_style_sampling
from lerobot_swr.trajectories import Trajectories

TEXT_FLAGS = ("behavior_rule", "policy.style_filter")


@parser.wrap()
def evaluate(cfg: EvalCommand) -> None:
    """Make a check and write its result beside its picture."""
    assert cfg.output_dir is not None
    assert cfg.check is not None
    actor, trajectories = _load(cfg)
    subject = Subject(cfg.dataset, trajectories, cfg, actor, cfg.env, _rule(cfg))
    file, provenance = cfg.output_dir / cfg.check.file, _provenance(cfg)
    finding = cfg.check.run(subject, lambda result: write_json(file.with_suffix(".json"), result, provenance))
    write_json(file.with_suffix(".json"), finding.result, provenance)
    if finding.draw is not None:
        finding.draw(file.with_suffix(".png"))
    print(f"{subject.title}\n{finding.text}\nwritten to {cfg.output_dir}")


def _load(cfg: EvalCommand) -> tuple[Checkpoint | None, Trajectories]:
    """Who acts, and the demonstrations; both fit the environment and each other."""
    if cfg.policy is not None:
        checkpoint = load_checkpoint(cfg.policy, cfg.rename_map)
        if cfg.env is None:
            return checkpoint, load_reference(cfg.dataset, checkpoint, needs_actions=True)
        check_environment(cfg.env, checkpoint.shapes, cfg.rename_map, "the checkpoint")
        reference = load_reference(cfg.dataset, checkpoint, needs_actions=cfg.scenes is not None)
        return checkpoint, in_simulation(reference)
    assert cfg.env is not None
    trajectories = load_demonstrations(cfg.dataset.metadata())
    shapes = {key: column.shape[1:] for key, column in trajectories.columns.items()}
    check_environment(cfg.env, shapes, {}, "the dataset")
    if cfg.baseline != "playback":
        return None, trajectories
    sampling = check_style_sampling(cfg.style_sampling or "uniform")
    return playback_checkpoint(trajectories, sampling, cfg.dataset.episodes), trajectories


def _rule(cfg: EvalCommand) -> BehaviorRule | None:
    assert cfg.check is not None
    if cfg.behavior_rule is not None:
        return load_behavior_rule(cfg.behavior_rule)
    if cfg.env is None:
        return None
    try:
        return task_of(cfg.env).behavior_rule()
    except MissingRuleError:
        if cfg.check.needs_rule:
            raise
        return None


def _provenance(cfg: EvalCommand) -> dict[str, Any]:
    """What it takes to make a result again."""
    assert cfg.check is not None
    nobody = cfg.baseline or cfg.check.type
    return {
        "command": " ".join(["lerobot-swr-eval", *sys.argv[1:]]),
        "policy_path": None if cfg.policy is None else str(cfg.policy.pretrained_path),
        "policy": nobody if cfg.policy is None else draccus.encode(cfg.policy, PreTrainedConfig),
        "env": None if cfg.env is None else draccus.encode(cfg.env, EnvConfig),
        "dataset": draccus.encode(cfg.dataset),
        "seed": cfg.seed,
        "versions": {name: version(name) for name in ("lerobot_policy_swr", "lerobot", "torch", "numpy")},
    }


@explain_errors
def main() -> None:
    """Entry point."""
    refuse_former_flags(sys.argv[1:])
    init_logging()
    register_third_party_plugins()
    sys.argv = list(with_literal_text(sys.argv, TEXT_FLAGS))
    check_dataset_folder()  # the parser would hide what it says
    evaluate()


if __name__ == "__main__":
    main()
