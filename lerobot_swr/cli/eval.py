"""``lerobot-swr-eval``: which behaviours does a policy show, and which were demonstrated?

With an environment it rolls the policy out; without one it measures action errors on the dataset's frames.

Examples:
    lerobot-swr-eval --policy.path=outputs/train/wzbc/checkpoints/last/pretrained_model \
        --env.type=maze2d --env.task=medium --dataset.root=data/only_forward \
        --n_episodes=100 --style_sampling=stratified

    lerobot-swr-eval --policy.path=... --dataset.root=path/to/real_robot_dataset

    lerobot-swr-eval --baseline=replay --env.type=d3il --env.task=avoiding --dataset.root=data/recorded
"""

import sys
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
from lerobot_swr.cli.eval_options import EvalCommand
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.configuration import check_dataset_folder
from lerobot_swr.envs.task import MissingRuleError, task_of
from lerobot_swr.evaluation.behavior_evaluation import compare, format_result, write_json
from lerobot_swr.evaluation.blending import format_blends, run_blends
from lerobot_swr.evaluation.checkpoint import (
    Checkpoint,
    check_environment,
    in_simulation,
    load_checkpoint,
    load_demonstrations,
    load_reference,
)
from lerobot_swr.evaluation.counterfactual import format_counterfactual, run_counterfactual
from lerobot_swr.evaluation.length_control import (
    evaluate_length_control,
    format_length_control,
    frames_after_end,
)
from lerobot_swr.evaluation.offline import (
    KINDS,
    format_offline,
    frame_errors,
    known_behaviors,
    summarize,
)
from lerobot_swr.evaluation.playback import playback_checkpoint
from lerobot_swr.evaluation.plots import plot_behaviors, plot_offline
from lerobot_swr.evaluation.replay import format_replay, run_replay
from lerobot_swr.evaluation.replay_plots import plot_replay
from lerobot_swr.evaluation.robustness import format_robustness, run_robustness
from lerobot_swr.evaluation.steering_plots import plot_blends, plot_counterfactual, plot_length_control
from lerobot_swr.trajectories import Trajectories

TEXT_FLAGS = ("behavior_rule", "policy.style_filter")


@parser.wrap()
def evaluate(cfg: EvalCommand) -> None:
    """Evaluate a checkpoint by rollouts, or offline without an environment."""
    assert cfg.output_dir is not None
    if cfg.baseline == "replay":
        _replay(cfg)
        return
    checkpoint, trajectories = _load(cfg)
    title = f"{checkpoint.policy.config.type} on {Path(trajectories.name).name}"
    if cfg.env is None:
        rule = None if cfg.behavior_rule is None else load_behavior_rule(cfg.behavior_rule)
        behaviors = known_behaviors(checkpoint, trajectories, rule)
        errors = frame_errors(checkpoint, trajectories, cfg.dataset.episodes, cfg.seed, behaviors)
        offline = summarize(errors)
        write_json(cfg.output_dir / "offline.json", offline, _provenance(cfg))
        per_frame = {kind: squared.mean(axis=1) for kind, squared in errors.squared.items()}
        plot_offline(cfg.output_dir / "offline.png", per_frame, errors.phase, KINDS.__getitem__, title)
        print(f"{title}\n{format_offline(offline)}\nwritten to {cfg.output_dir}")
        return

    if cfg.robustness:
        file, provenance = cfg.output_dir / "robustness.json", _provenance(cfg)
        robustness = run_robustness(
            checkpoint,
            trajectories,
            cfg.env,
            _rule(cfg),
            cfg.n_episodes,
            cfg.batch_size,
            cfg.seed,
            reference_episodes=cfg.dataset.episodes,
            after_each=lambda result: write_json(file, result, provenance),  # so that no result is lost
        )
        print(f"{title}\n{format_robustness(robustness)}\nwritten to {cfg.output_dir}")
        return
    if cfg.counterfactual or cfg.blend:
        _steer(cfg, checkpoint, trajectories, title)
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
        recorded_starts=cfg.recorded_starts,
        scenes=cfg.scenes,  # type: ignore[arg-type]
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
    print(f"{title}\n{format_result(result)}")
    if cfg.length_band is not None:
        control = evaluate_length_control(
            [episode["length"] for episode in result.episodes],
            trajectories.lengths.tolist(),
            (cfg.length_band[0], cfg.length_band[1]),
            frames_after_end(trajectories, cfg.env),
        )
        write_json(cfg.output_dir / "length_control.json", control, _provenance(cfg))
        plot_length_control(cfg.output_dir / "length_control.png", control, f"{title}: L1 {control.l1:.3f}")
        print(format_length_control(control))
    print(f"written to {cfg.output_dir}")


def _load(cfg: EvalCommand) -> tuple[Checkpoint, Trajectories]:
    if cfg.policy is None:
        trajectories = load_demonstrations(cfg.dataset.metadata())
        sampling = cfg.style_sampling or "uniform"
        assert cfg.env is not None
        shapes = {key: column.shape[1:] for key, column in trajectories.columns.items()}
        check_environment(cfg.env, shapes, {}, "the dataset")
        playback = playback_checkpoint(trajectories, sampling, cfg.dataset.episodes)  # type: ignore[arg-type]
        return playback, trajectories
    checkpoint = load_checkpoint(cfg.policy, cfg.rename_map)
    if cfg.env is None:
        return checkpoint, load_reference(cfg.dataset, checkpoint, needs_actions=True)
    check_environment(cfg.env, checkpoint.shapes, cfg.rename_map, "the checkpoint")
    reference = load_reference(cfg.dataset, checkpoint, needs_actions=cfg.scenes is not None)
    return checkpoint, in_simulation(reference)


def _replay(cfg: EvalCommand) -> None:
    """Play the dataset's actions and compare what the environment shows with what was recorded."""
    assert cfg.env is not None
    assert cfg.output_dir is not None
    try:
        rule = _rule(cfg)
    except MissingRuleError:
        rule = None  # success and deviation do not need one
    meta = cfg.dataset.metadata()
    result, recorded, observed = run_replay(
        meta, cfg.env, rule, cfg.dataset.episodes, cfg.batch_size, cfg.seed
    )
    write_json(cfg.output_dir / "replay.json", result, _provenance(cfg))
    title = f"replay of {meta.root.name}: {result.finding}"
    plot_replay(cfg.output_dir / "replay.png", result, recorded, observed, task_of(cfg.env), title)
    print(f"replay of {meta.root.name}\n{format_replay(result)}\nwritten to {cfg.output_dir}")


def _steer(cfg: EvalCommand, checkpoint: Checkpoint, trajectories: Trajectories, title: str) -> None:
    """The checks that request styles."""
    assert cfg.env is not None
    assert cfg.output_dir is not None
    rule = _rule(cfg)
    if cfg.counterfactual:
        check, _ = run_counterfactual(
            checkpoint, trajectories, cfg.env, rule, cfg.counterfactual, cfg.batch_size, cfg.seed
        )
        write_json(cfg.output_dir / "counterfactual.json", check, _provenance(cfg))
        heading = f"{title}: control accuracy {check.control_accuracy:.3f}"
        plot_counterfactual(cfg.output_dir / "counterfactual.png", check, heading)
        print(f"{title}\n{format_counterfactual(check)}")
    if cfg.blend:
        demonstrated = [rule(episode) for episode in trajectories.episodes()]
        blends, rollouts = run_blends(
            checkpoint, cfg.env, rule, demonstrated, cfg.blend, cfg.batch_size, cfg.seed
        )
        write_json(cfg.output_dir / "blend.json", blends, _provenance(cfg))
        task = task_of(cfg.env)
        paths = [task.plot_path(rollout.observations) for rollout in rollouts]
        plot_blends(cfg.output_dir / "blend.png", blends, paths, cfg.env, f"{title}: blends of two styles")
        print(f"{title}\n{format_blends(blends)}")
    print(f"written to {cfg.output_dir}")


def _rule(cfg: EvalCommand) -> BehaviorRule:
    if cfg.behavior_rule is not None:
        return load_behavior_rule(cfg.behavior_rule)
    assert cfg.env is not None
    return task_of(cfg.env).behavior_rule()


def _provenance(cfg: EvalCommand) -> dict[str, Any]:
    """What it takes to make a result again."""
    return {
        "command": " ".join(["lerobot-swr-eval", *sys.argv[1:]]),
        "policy_path": None if cfg.policy is None else str(cfg.policy.pretrained_path),
        "policy": cfg.baseline if cfg.policy is None else draccus.encode(cfg.policy, PreTrainedConfig),
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
    sys.argv = list(with_literal_text(sys.argv, TEXT_FLAGS))
    check_dataset_folder()  # the parser would hide what it says
    evaluate()
