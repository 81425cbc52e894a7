"""The frames that zbc and wzbc draw in training with corrective labels: which, how many, in which units."""

import copy
import re

import numpy as np
import pytest
import torch
from corrective_policies import ACTION, ENV, STATE, batch_of, every_frame, make
from lerobot.policies import make_pre_post_processors

from lerobot_swr.policies.lessons import logged

FEATURES = (STATE, ENV, ACTION)


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_without_corrective_labels_nothing_is_added(small_maze, policy_type):
    """The default is the paper's: no tensor, no draw and no figure more, the actions the network's."""
    policy, meta = make(small_maze, policy_type)
    assert policy.config.corrective == "none"
    assert policy.correct is None
    assert not [key for key in policy.state_dict() if "correct" in key]
    batch = batch_of(policy, meta, every_frame(policy))
    drawn = policy.draw(batch)
    assert drawn.corrective is None
    assert all(torch.equal(drawn.batch[key], batch[key]) for key in (STATE, ENV, ACTION))
    style = policy.styles.embedding(batch["episode_index"])
    assert torch.equal(policy.predict(batch, style), policy.backbone(batch, style))


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
@pytest.mark.parametrize("kind", ["noise", "demos"])
def test_half_of_the_frames_are_corrective(small_maze, policy_type, kind):
    """They are no frames of the batch; the others stay what they are without corrective labels."""
    policy, meta = make(small_maze, policy_type, corrective=kind)
    plain, _ = make(small_maze, policy_type)
    batch = batch_of(policy, meta, every_frame(policy))
    drawn, expected = policy.draw(batch), plain.draw(batch)
    corrective = drawn.corrective
    assert int(corrective.sum()) == len(corrective) // 2
    for key, value in expected.tensors(FEATURES).items():
        found = drawn.tensors(FEATURES)[key]
        assert torch.equal(found[~corrective], value[~corrective]), key
        assert found.dtype == value.dtype, key  # float32: not every device has float64
    styles = drawn.episode[corrective]
    assert set(styles.tolist()) == set(range(6))
    if policy_type == "zbc":
        torch.testing.assert_close(drawn.weight[corrective], policy.balance.factors[styles])
    assert ((drawn.batch[STATE] != batch[STATE]).any(dim=1))[corrective].float().mean() > 0.9


def test_corrective_frames_teach_the_style_of_their_demonstration(small_maze):
    """With almost no noise every one is a frame of the episode whose style it teaches, with its action."""
    policy, meta = make(small_maze, corrective="noise", corrective_scale=1e-7)
    rows = every_frame(policy)
    batch = batch_of(policy, meta, rows)
    drawn = policy.draw(batch)
    demonstrated = batch_of(policy, meta, rows.sort().values)
    for place in drawn.corrective.nonzero().squeeze(1).tolist():
        own = demonstrated["episode_index"] == drawn.episode[place]
        distances = (demonstrated[STATE][own] - drawn.batch[STATE][place]).norm(dim=1)
        assert distances.min() < 1e-4
        torch.testing.assert_close(
            drawn.batch[ACTION][place], demonstrated[ACTION][own][distances.argmin()], atol=1e-3, rtol=0
        )


@pytest.mark.parametrize("partner_sampling", ["uniform", "weighted"])
def test_wzbc_relabels_corrective_frames_as_it_does_demonstrated_ones(small_maze, partner_sampling):
    """Algorithm 1's pairs of the demonstration i beside which a frame lies; no gradient into another's style.

    The weight is W(i, j) where partners are drawn uniformly, else what all pairs of i weigh together.
    """
    options = {
        "corrective": "noise",
        "corrective_scale": 1e-7,
        "p": 0.5,
        "partner_sampling": partner_sampling,
    }
    policy, meta = make(small_maze, "wzbc", **options)
    drawn = policy.draw(batch_of(policy, meta, every_frame(policy)))
    corrective, relabelled = drawn.corrective, drawn.corrective & ~drawn.teaches_style
    distances = policy.data.similarity.distance(np.arange(6)[:, None], np.arange(6))
    w = np.exp(-policy.config.beta * distances / distances.max(axis=1, keepdims=True))
    np.fill_diagonal(w, 1)
    mass = 0.5 + 0.5 * (w.sum(axis=1) - 1) / (len(w) - 1)
    share = (
        0.5
        if partner_sampling == "uniform"
        else np.average(1 - 0.5 / mass, weights=policy.trajectories.lengths)
    )
    assert float(relabelled.sum() / corrective.sum()) == pytest.approx(share, abs=0.1)
    everything = batch_of(policy, meta, every_frame(policy).sort().values)
    for place in corrective.nonzero().squeeze(1).tolist():
        apart = (everything[STATE] - drawn.batch[STATE][place]).norm(dim=1)
        owners = everything["episode_index"][apart < 1e-4].unique()  # several at a shared start
        i, j = owners.numpy(), int(drawn.episode[place])
        expected = (w[i, j] if partner_sampling == "uniform" else mass[i]) * policy.balance.factors[
            owners
        ].numpy()
        assert np.isclose(float(drawn.weight[place]), expected, rtol=1e-4).any()
    losses, styles = policy.loss(drawn)[1], policy.styles.embedding.weight
    (gradient,) = torch.autograd.grad(losses[relabelled].sum(), styles, retain_graph=True)
    assert not gradient.any()
    (gradient,) = torch.autograd.grad(losses[corrective].sum(), styles)
    assert gradient.any(dim=1).all()


def test_the_larger_half_of_odd_batches_takes_turns(small_maze):
    """Batches of one frame are corrective every other time, whether drawn singly or together."""
    policy, meta = make(small_maze, corrective="noise")
    policy.draw(batch_of(policy, meta, every_frame(policy)))
    rows = torch.arange(10)
    singly = [bool(policy.draw(batch_of(policy, meta, row[None])).corrective) for row in rows]
    assert sum(singly) == 5
    assert singly == singly[:2] * 5
    together = policy.draw(batch_of(policy, meta, rows), steps=10).corrective
    assert together.tolist() == singly


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "IDENTITY"])
def test_corrective_frames_are_normalised_as_lerobot_normalises(small_maze, mode):
    """Raw labels through LeRobot's own preprocessor are what the policy draws, under every normalisation."""
    mapping = dict.fromkeys(("STATE", "ENV", "ACTION"), mode)
    policy, meta = make(small_maze, corrective="noise", normalization_mapping=mapping)
    correct = policy.correct
    drawn = policy.draw(batch_of(policy, meta, every_frame(policy)))
    n, per_frame = int(drawn.corrective.sum()), correct.stream.labels.draws_per_frame
    uniforms = correct.draws.uniforms_at(0, n, per_frame).reshape(n, per_frame)
    raw = correct.stream.labels.draw(uniforms, np.arange(6))
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    expected = {**raw.observations, ACTION: raw.actions}
    expected = preprocessor({key: torch.from_numpy(value) for key, value in expected.items()})
    for key in (STATE, ENV, ACTION):
        torch.testing.assert_close(drawn.batch[key][drawn.corrective], expected[key], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("size", [16, 5])
@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_many_steps_drawn_at_once_are_those_drawn_one_by_one(small_maze, policy_type, size):
    """From the first step on, and later; bit for bit."""
    one, meta = make(small_maze, policy_type, corrective="demos")
    many = copy.deepcopy(one)
    rows = every_frame(one)[: 10 * size].view(10, size)
    for part in (rows[:6], rows[6:]):
        singly = [one.draw(batch_of(one, meta, step)) for step in part]
        at_once = many.draw(batch_of(many, meta, part.flatten()), len(part))
        parts = [drawn.tensors(FEATURES) for drawn in singly]
        for key, value in at_once.tensors(FEATURES).items():
            assert torch.equal(value, torch.cat([part[key] for part in parts])), key
        assert torch.equal(at_once.corrective, torch.cat([drawn.corrective for drawn in singly]))


def test_corrective_frames_do_not_depend_on_how_many_are_drawn_together(small_maze, monkeypatch):
    """Blocks bound the memory; they do not change what is drawn."""
    drawn = []
    for block in (256, 7):
        monkeypatch.setattr("lerobot_swr.corrective.frames.BLOCK", block)
        policy, meta = make(small_maze, corrective="demos")
        drawn.append(policy.draw(batch_of(policy, meta, every_frame(policy))))
    found = [lesson.tensors(FEATURES) for lesson in drawn]
    for key in ("episode", STATE, ACTION):
        torch.testing.assert_close(found[0][key], found[1][key], atol=1e-5, rtol=1e-5)


def test_pairs_and_corrective_draws_are_independent(small_maze):
    """The streams of random numbers differ, and each step's differ from the last one's."""
    policy, _ = make(small_maze, "wzbc", corrective="noise")
    pairs, labels = policy.relabel.draws.uniforms(2, 500), policy.correct.draws.uniforms(2, 500)
    assert abs(np.corrcoef(pairs, labels)[0, 1]) < 0.15
    assert abs(np.corrcoef(labels[:500], labels[500:])[0, 1]) < 0.2


def test_figures_count_each_kind_of_frame_for_itself(small_maze):
    """corrective_loss, own_style_loss and relabelled_loss recomputed from the drawn frames' errors."""
    policy, meta = make(small_maze, "wzbc", corrective="demos", p=0.4)
    drawn = policy.draw(batch_of(policy, meta, every_frame(policy)))
    losses = policy.loss(drawn)[1].detach()
    figures = logged(policy.steps, drawn, losses)
    corrective, relabelled = drawn.corrective, ~drawn.teaches_style
    assert figures["corrective_loss"] == pytest.approx(float((losses * corrective).mean() / 0.5), rel=1e-5)
    own = ~corrective & ~relabelled
    assert figures["own_style_loss"] == pytest.approx(float((losses * own).mean() / 0.6 / 0.5), rel=1e-5)
    others = float((losses * (relabelled & ~corrective)).mean() / 0.4 / 0.5)
    assert figures["relabelled_loss"] == pytest.approx(others, rel=1e-5)
    demonstrated = 0.6 * figures["own_style_loss"] + 0.4 * figures["relabelled_loss"]
    whole = (demonstrated + figures["corrective_loss"]) / 2
    assert whole == pytest.approx(float(losses.mean()), rel=1e-5)


def test_demos_says_how_many_states_others_lend(small_maze, caplog):
    """The logged share is that of other random numbers, within chance."""
    with caplog.at_level("INFO"):
        policy, _ = make(small_maze, corrective="demos")
    logged = float(re.search(r"corrective=demos: about (\d+) %", caplog.text)[1]) / 100
    labels = policy.correct.stream.labels
    numbers = np.random.default_rng(5).random((2000, labels.draws_per_frame))
    assert 0 < logged < 1
    assert logged == pytest.approx(labels.draw(numbers, np.arange(6)).borrowed.mean(), abs=0.12)
