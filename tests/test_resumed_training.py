"""``lerobot-swr-train`` killed and resumed: at any step, in any epoch, it ends as it would have."""

import shutil
from pathlib import Path

import pytest
from conftest import train_flags
from lerobot.configs.default import DatasetConfig
from lerobot.policies.factory import make_policy_config
from training_command import assert_same_checkpoint, forget_after, swr_train_killed_at

from lerobot_swr.training import SeedsTrainConfig
from lerobot_swr.training.separate_training import train_run

# Two episodes of the small maze in batches of 32: an epoch has 4 steps, the last one with fewer frames. With
# diffusion, which leaves the episodes' ends out, it has 3.
EPISODES, BATCH_SIZE = [0, 4], 32
STEPS, STOPS = 12, (2, 4, 6, 10)  # within the first epoch, at its end, within the second and the third

SMALL = {
    "beso": {"dim_model": 16, "n_heads": 2},
    "act": {"dim_model": 16, "n_heads": 2, "dim_feedforward": 16, "latent_dim": 4, "n_encoder_layers": 1}
    | {"n_vae_encoder_layers": 1, "chunk_size": 4, "n_action_steps": 4},
    "diffusion": {"down_dims": [16, 32], "n_groups": 4, "horizon": 8, "diffusion_step_embed_dim": 8},
}
SMALL_NETWORK = ("--policy.backbone.hidden_dim=16", "--policy.backbone.num_hidden=2", "--log_freq=5")


def small_run(policy_type: str, root: Path, output_dir: Path):
    """Configuration of one seed's short run."""
    policy = make_policy_config(policy_type, device="cpu", push_to_hub=False, **SMALL[policy_type])
    config = SeedsTrainConfig(
        DatasetConfig("local/small_maze", root=str(root), episodes=EPISODES),
        policy=policy,
        output_dir=output_dir,
        seeds=[3],
        jobs=1,
        batch_size=BATCH_SIZE,
        num_workers=0,
        steps=STEPS,
        save_freq=2,
        resume=True,
    )
    config.validate()
    return config.of_seed(3)


@pytest.mark.parametrize("policy_type", SMALL)
def test_a_run_of_lerobots_loop_goes_on_exactly_from_any_step(small_maze, tmp_path, policy_type):
    """Stopped again and again: weights, optimizer and random numbers of later checkpoints are the same."""
    train_run(small_run(policy_type, small_maze, tmp_path / "whole"))
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped", symlinks=True)
    for stop in STOPS:
        forget_after(stop, tmp_path / "stopped/seed_3")
        train_run(small_run(policy_type, small_maze, tmp_path / "stopped"))
        for step in range(stop, STEPS + 1, 2):
            checkpoint = Path(f"seed_3/checkpoints/{step:06d}")
            assert_same_checkpoint(tmp_path / "whole" / checkpoint, tmp_path / "stopped" / checkpoint)


def test_stacked_seeds_go_on_exactly_from_any_step(swr_train, small_maze, tmp_path):
    """Seeds that were stopped at different steps, in different epochs."""
    flags = [*SMALL_NETWORK, f"--dataset.episodes={EPISODES}", f"--batch_size={BATCH_SIZE}", "--save_freq=2"]
    whole, stopped = (
        train_flags("zbc", small_maze, tmp_path / name, STEPS, *flags, "--jobs=1")
        for name in ("whole", "stopped")
    )
    swr_train(*whole, "--seeds=0,1,2,3")
    shutil.copytree(tmp_path / "whole", tmp_path / "stopped", symlinks=True)
    for seed, stop in enumerate(STOPS):
        forget_after(stop, tmp_path / f"stopped/seed_{seed}")
        swr_train(*stopped, f"--seeds={seed}", "--resume=true")
        for step in range(stop, STEPS + 1, 2):
            checkpoint = Path(f"seed_{seed}/checkpoints/{step:06d}")
            assert_same_checkpoint(tmp_path / "whole" / checkpoint, tmp_path / "stopped" / checkpoint)


@pytest.mark.parametrize(
    ("policy_type", "jobs", "processes"),
    [("beso", 2, 2), ("wzbc", 1, 1), ("wzbc", 2, 2)],
)
def test_a_killed_command_goes_on_to_the_same_weights(
    swr_train, small_maze, tmp_path, policy_type, jobs, processes
):
    """kill -9 in a checkpoint of the third epoch, then --resume=true from the second: as if uninterrupted."""
    options = SMALL_NETWORK if policy_type == "wzbc" else ("--policy.dim_model=16", "--policy.n_heads=2")
    seeds = range(3 if policy_type == "wzbc" else 2)
    flags = [
        *(*options, f"--dataset.episodes={EPISODES}", f"--batch_size={BATCH_SIZE}", "--save_freq=5"),
        *(f"--seeds={','.join(map(str, seeds))}", f"--jobs={jobs}"),
    ]
    swr_train(*train_flags(policy_type, small_maze, tmp_path / "whole", 15, *flags))
    killed = train_flags(policy_type, small_maze, tmp_path / "killed", 15, *flags)
    swr_train_killed_at(10, killed, processes)
    for seed in seeds:
        checkpoints = tmp_path / f"killed/seed_{seed}/checkpoints"
        assert not (checkpoints / "000010/training_state").exists()
    swr_train(*killed, "--resume=true")
    for seed in seeds:
        last = Path(f"seed_{seed}/checkpoints/000015")
        assert_same_checkpoint(tmp_path / "whole" / last, tmp_path / "killed" / last)
