"""Styles for new demonstrations: the optimum, the enlarged checkpoint, the held-out loss."""

import hashlib
from unittest.mock import patch

import numpy as np
import pytest
import torch
from conftest import make_batch, save_checkpoint
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from odd_datasets import PLAIN, arcs, feature, metadata, write
from torch import nn

from lerobot_swr.cli import styles as styles_command
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.policies.modeling_swr import ZBCPolicy
from lerobot_swr.styles import extension as style_extension
from lerobot_swr.styles.encoding import FRAMES, FRAMES_PER_STEP, ROWS, STARTS, encode_styles
from lerobot_swr.styles.table import load_style_table


class Additive(nn.Module):
    """a = s + z: the best style of an episode is the mean of a - s."""

    def forward(self, batch, style):
        """(B, 2) actions."""
        return batch["observation.state"] + style


def episode(length: int, seed: int) -> dict[str, torch.Tensor]:
    """Random frames."""
    generator = torch.Generator().manual_seed(seed)
    return {key: torch.randn(length, 2, generator=generator) for key in ("observation.state", "action")}


def test_the_style_is_the_least_squares_optimum():
    """Against the closed form, for episodes of different length and starts of different quality."""
    episodes = [episode(5, 0), episode(30, 1), episode(1, 2)]
    expected = torch.stack([(e["action"] - e["observation.state"]).mean(dim=0) for e in episodes])
    starts = expected[:, None] + torch.tensor([0.7, -0.3])[None, :, None]
    styles, errors = encode_styles(Additive(), episodes, starts)
    assert torch.allclose(styles, expected, atol=2e-3)
    residual = [
        (e["action"] - e["observation.state"] - z).square().mean()
        for e, z in zip(episodes, expected, strict=True)
    ]
    assert torch.allclose(errors, torch.stack(residual), atol=1e-4)


def test_encoding_never_ends_worse_than_it_started_and_leaves_no_trace(make_tiny_policy):
    """Weights, their gradients and torch's random numbers stay; the error is at most the best start's."""
    policy = make_tiny_policy("zbc")
    policy.train()
    policy.forward(make_batch())[0].backward()
    before = [(p.detach().clone(), p.grad.clone()) for p in policy.parameters()]
    state = torch.get_rng_state()
    frames = {k: v[:7] for k, v in make_batch().items() if k != "episode_index"}
    starts = policy.styles.embedding.weight.detach()[None, :3]
    with torch.no_grad():
        _, first = encode_styles(policy.backbone, [frames], starts, steps=0)
        _, error = encode_styles(policy.backbone, [frames], starts, steps=30)
    assert error < first
    assert torch.equal(torch.get_rng_state(), state)
    for parameter, (value, gradient) in zip(policy.parameters(), before, strict=True):
        assert torch.equal(parameter, value)
        assert torch.equal(parameter.grad, gradient)


def test_held_out_episodes_are_scored_with_an_encoded_style(make_tiny_policy):
    """Not worse than the nearest trained style on the whole episode, unmarked, and renewed after training."""
    policy = make_tiny_policy("zbc", episodes=[0, 1, 2, 3], balance_episodes=False).eval()
    frames = policy.data.frames(5, np.arange(policy.trajectories.lengths[5]))
    held_out = {**frames, "episode_index": torch.full((len(frames["action"]),), 5)}
    nearest = int(policy.data.similarity.distance(5, np.arange(4)).argmin())
    borrowed = {**held_out, "episode_index": torch.full_like(held_out["episode_index"], nearest)}
    with torch.no_grad():
        loss = policy.forward(held_out)[0]
        assert loss < policy.forward(borrowed)[0]
        assert loss == policy.forward(held_out)[0]
    assert policy.styles.trained.tolist() == [1, 1, 1, 1, 0, 0]
    policy.train()
    with torch.no_grad():
        policy.backbone.head.bias += 1
    policy.eval()
    with torch.no_grad():
        assert policy.forward(held_out)[0] != loss


def digest(folder) -> dict[str, str]:
    """Hash of every file."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}


def test_left_out_episodes_get_a_style_at_their_own_place(
    make_tiny_policy, small_maze, small_maze_meta, tmp_path, run_command
):
    """The original stays as it was; network and trained styles are the same in the new checkpoint."""
    policy = make_tiny_policy("zbc", episodes=[0, 1, 2, 3])
    folder = save_checkpoint(policy, small_maze_meta, tmp_path / "old")
    before = digest(folder)
    flags = [f"--dataset.root={small_maze}", f"--add={small_maze}", f"--output_dir={tmp_path / 'new'}"]
    run_command(styles_command.main, folder, *flags)
    assert digest(folder) == before
    old, new = ZBCPolicy.from_pretrained(folder), ZBCPolicy.from_pretrained(tmp_path / "new")
    assert new.styles.trained.tolist() == [1] * 6
    assert new.config.num_added_styles == 0
    for key, value in old.backbone.state_dict().items():
        assert torch.equal(value, new.backbone.state_dict()[key])
    assert torch.equal(old.styles.embedding.weight[:4], new.styles.embedding.weight[:4])
    assert not torch.equal(old.styles.embedding.weight[4:], new.styles.embedding.weight[4:])
    assert new.styles.filter("episode >= 4") == [4, 5]


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_demonstrations_of_another_dataset_are_appended_with_their_rows(
    make_tiny_policy, small_maze, small_maze_meta, tmp_path, run_command, policy_type
):
    """Styles, table and neighbours grow; the new styles can be filtered and drawn."""
    folder = save_checkpoint(make_tiny_policy(policy_type), small_maze_meta, tmp_path / "old")
    write_dataset(_recipe("more", "small", {"20": 2, "10": 1}, steady), tmp_path / "more", seed=5)
    flags = [f"--dataset.root={small_maze}", f"--add={tmp_path / 'more'}", "--episodes=[0,2]"]
    run_command(styles_command.main, folder, *flags, f"--output_dir={tmp_path / 'new'}")
    policy = type(make_tiny_policy(policy_type)).from_pretrained(tmp_path / "new")
    assert len(policy.styles) == len(policy.styles.table) == 8
    assert policy.config.num_episodes == 6
    assert policy.styles.table.columns["episode"] == list(range(8))
    assert sorted(policy.styles.table.neighbours[6].tolist()) == [0, 1, 2, 3, 4, 5, 7]
    assert policy.styles.table.neighbours[0, -1] == -1  # which has five others, of before
    assert policy.styles.filter("episode >= 6") == [6, 7]
    policy.styles.select([6, 7])
    policy.select_action(make_batch(40))
    assert set(policy.styles.active.tolist()) == {6, 7}


def test_adding_nothing_or_to_an_existing_folder_is_refused(
    make_tiny_policy, small_maze, small_maze_meta, tmp_path, run_command, capsys
):
    """Each with a message that names the fix; no folder appears."""
    folder = save_checkpoint(make_tiny_policy("zbc"), small_maze_meta, tmp_path / "old")
    source = [f"--dataset.root={small_maze}", f"--add={small_maze}"]
    for flags, message in (
        ([*source, f"--output_dir={tmp_path / 'new'}"], "have a style already"),
        ([*source, f"--output_dir={folder}"], "exists; choose another folder"),
        (source, "belong together"),
    ):
        with pytest.raises(SystemExit):
            run_command(styles_command.main, folder, *flags)
        assert message in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


def test_long_episodes_are_encoded_as_well_as_short_ones_at_no_more_cost():
    """4,000 frames, in batches that do not grow with them: nearly the optimum of all frames."""
    long, seen = episode(4000, 3), []

    class Counting(Additive):
        def forward(self, batch, style):
            seen.append(len(style))
            return super().forward(batch, style)

    drift = torch.linspace(-1, 1, 4000)[:, None]  # what is right differs along the way
    long["action"] = long["observation.state"] + drift + torch.tensor([0.5, -0.25]) + 0.1 * long["action"]
    expected = (long["action"] - long["observation.state"]).mean(dim=0)
    steps: list[int] = []
    starts = torch.zeros(1, STARTS, 2) + torch.linspace(-1, 1, STARTS)[None, :, None]
    styles, errors = encode_styles(Counting(), [long], starts, on_step=lambda: steps.append(1))
    torch.testing.assert_close(styles[0], expected, atol=0.01, rtol=0)
    residual = (long["action"] - long["observation.state"] - expected).square().mean()
    torch.testing.assert_close(errors[0], residual, rtol=0.02, atol=0)
    assert max(seen) <= ROWS
    assert sum(seen) <= STARTS * (FRAMES_PER_STEP * len(steps) + 2 * FRAMES)
    assert len(steps) == 200


def test_encoding_is_deterministic(make_tiny_policy):
    """The same demonstration gives the same style."""
    policy = make_tiny_policy("zbc")
    frames = {k: v[:9] for k, v in make_batch().items() if k != "episode_index"}
    starts = policy.styles.embedding.weight.detach()[None, :2]
    once, again = (encode_styles(policy.backbone, [frames], starts, steps=10)[0] for _ in range(2))
    assert np.array_equal(once.numpy(), again.numpy())


REWARDED = {**PLAIN, "next.reward": feature(1), "next.success": feature(1, dtype="bool")}


def rewarded(i, t, n):
    """A frame of an arc with rewards that sum up to its number."""
    return {
        **arcs(i, t, n),
        "next.reward": np.array([i / n], np.float32),
        "next.success": np.array([t == n - 1]),
    }


@pytest.fixture
def rewarded_checkpoint(tmp_path):
    """A checkpoint trained on arcs with rewards, and the dataset."""
    root = write(tmp_path / "data", REWARDED, rewarded)
    config = make_policy_config("zbc", backbone=MLPConfig(8, 1), device="cpu", push_to_hub=False)
    meta = metadata(root)
    return save_checkpoint(make_policy(config, ds_meta=meta), meta, tmp_path / "old"), root


def test_demonstrations_with_rewards_are_added_with_their_outcomes(
    rewarded_checkpoint, tmp_path, run_command, capsys
):
    """The columns return and success go on, and can be filtered by name."""
    folder, root = rewarded_checkpoint
    new = write(tmp_path / "more", REWARDED, lambda i, t, n: rewarded(i + 4, t, n), lengths=(5, 9))
    run_command(
        styles_command.main, folder, f"--add={new}", f"--dataset.root={root}", f"--output_dir={root}_new"
    )
    table = load_style_table(f"{root}_new")
    np.testing.assert_allclose(table.columns["return"], range(6), rtol=1e-5)
    assert table.columns["success"] == [True] * 6
    run_command(styles_command.main, f"{root}_new", "--filter=return > 3.5 and success")
    assert "2 of 6 demonstrations: 4, 5" in capsys.readouterr().out


def test_demonstrations_without_rewards_cost_the_column_unless_a_filter_needs_it(
    rewarded_checkpoint, tmp_path, run_command, capsys
):
    """In the new checkpoint only; what a named filter looks at is refused before anything is encoded."""
    folder, root = rewarded_checkpoint
    new = write(tmp_path / "more", lengths=(5, 9))
    flags = [f"--dataset.root={root}", f"--add={new}"]
    run_command(styles_command.main, folder, *flags, f"--output_dir={root}_new")
    assert "return" not in load_style_table(f"{root}_new").columns
    assert "return" in load_style_table(folder).columns
    run_command(styles_command.main, folder, "--filter=return > 1", "--name=well")
    with (
        patch.object(style_extension, "encode_styles", side_effect=AssertionError("encoded")),
        pytest.raises(SystemExit),
    ):
        run_command(styles_command.main, folder, *flags, f"--output_dir={root}_other")
    assert "['return', 'success'] of the checkpoint's table, which the named filters ['well']" in (
        capsys.readouterr().err
    )
