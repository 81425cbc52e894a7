"""The steps that make a lesson of a batch."""

import pytest
import torch
from conftest import OBSERVATIONS, make_batch

from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.policies.lessons import Balance, Correct, Lesson, Relabel

# Losses of the first and the eighth training step, and then the held-out loss, as version 0.1 had them.
VERSION_0_1 = [
    ("bc", {}, (0.8357517, 1.1814193, 0.9323485)),
    ("bc", {"balance_episodes": False}, (0.8203617, 1.1622832, 0.9354889)),
    ("zbc", {}, (0.7551538, 1.2352684, 0.7976561)),
    ("zbc", {"corrective": "noise"}, (2.3190989, 2.5669994, 0.7891447)),
    ("zbc", {"corrective": "demos"}, (4.5343981, 2.3485956, 0.7960835)),
    ("wzbc", {}, (0.1671380, 0.2725307, 0.7992035)),
    ("wzbc", {"partner_sampling": "uniform"}, (0.2435539, 0.3367196, 0.7837366)),
    ("wzbc", {"corrective": "demos"}, (1.0082653, 0.5130501, 0.7965000)),
    (
        "wzbc",
        {"corrective": "noise", "beta": 2.0, "p": 0.5, "balance_episodes": False},
        (1.5384519, 1.7275561, 0.7866006),
    ),
    ("wzbc", {"backbone": MLPConfig(16, 3, residual=False)}, (0.1791445, 0.2790019, 0.7781051)),
]


def shuffled_batch(seed: int) -> dict[str, torch.Tensor]:
    """32 frames of the small maze's dimensions, in an order of their own."""
    generator = torch.Generator().manual_seed(seed)
    episodes = (torch.arange(32) % 6)[torch.randperm(32, generator=generator)]
    keys = (*OBSERVATIONS, "action")
    return {**{key: torch.randn(32, 2, generator=generator) for key in keys}, "episode_index": episodes}


@pytest.mark.parametrize(("policy_type", "options", "expected"), VERSION_0_1)
def test_training_is_that_of_version_0_1(make_tiny_policy, policy_type, options, expected):
    """Network, draws, weights, losses and updates of a few steps, to six digits."""
    policy = make_tiny_policy(policy_type, seed=3, **options).train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    losses = []
    for step in range(8):
        loss, _ = policy.forward(shuffled_batch(step))
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        losses.append(loss.item())
    with torch.no_grad():
        held_out = policy.eval().forward(shuffled_batch(100))[0].item()
    assert (losses[0], losses[-1], held_out) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(
    ("policy_type", "options", "expected"),
    [
        ("bc", {}, [Balance]),
        ("zbc", {}, [Balance]),
        ("zbc", {"corrective": "noise"}, [Balance, Correct]),
        ("wzbc", {}, [Balance, Relabel]),
        ("wzbc", {"corrective": "demos"}, [Balance, Correct, Relabel]),
    ],
)
def test_a_policy_is_its_lesson_steps(make_tiny_policy, policy_type, options, expected):
    """Corrective labels come before pairs, which are drawn for corrective frames, too."""
    assert [type(step) for step in make_tiny_policy(policy_type, **options).steps] == expected


def test_a_lesson_decides_what_a_frame_teaches(make_tiny_policy):
    """Gradient reaches the styles of `episode` where the frame teaches them, scaled by its weight."""
    policy = make_tiny_policy("zbc").train()
    batch = make_batch(4)
    weight = torch.tensor([1.0, 2.0, 0.0, 1.0])
    episode = torch.tensor([5, 4, 3, 2])
    teaches = torch.tensor([True, True, True, False])
    mean, losses = policy.loss(Lesson(batch, weight, episode, teaches))
    mean.backward()
    assert policy.styles.embedding.weight.grad.any(dim=1).tolist() == [False] * 4 + [True, True]
    predicted = policy.predict(batch, policy.styles.embedding(episode))
    expected = (predicted - batch["action"]).square().mean(dim=1) * weight
    torch.testing.assert_close(losses, expected)
    torch.testing.assert_close(mean, expected.mean())


def test_a_lesson_survives_being_taken_apart(make_tiny_policy):
    """What crosses into the training of stacked seeds gives the same loss."""
    policy = make_tiny_policy("wzbc", corrective="noise").train()
    lesson = policy.draw(make_batch())
    again = Lesson.of_tensors(
        lesson.tensors(["observation.state", "observation.environment_state", "action"])
    )
    assert torch.equal(policy.loss(again)[1], policy.loss(lesson)[1])
