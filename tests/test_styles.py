"""The style cookbook."""

from collections import Counter

import pytest
import torch

from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.request import BLENDED, StyleRequest
from lerobot_swr.styles.selection import StyleSelection


def make_cookbook(trained=(0, 1, 2, 3, 4, 5), **options) -> StyleCookbook:
    torch.manual_seed(0)
    cookbook = StyleCookbook(6, style_dim=3, init_scale=0.1, **options)
    cookbook.trained[list(trained)] = 1
    return cookbook


def test_uniform_drawing_is_uniform_over_trained_styles():
    """Every trained style at its share, no other one ever."""
    counts = Counter(make_cookbook(trained=[0, 2, 5]).draw(9000).tolist())
    assert set(counts) == {0, 2, 5}
    assert all(abs(count - 3000) < 250 for count in counts.values())


def test_stratified_drawing_uses_each_style_once_before_any_again_across_rollouts():
    """Batches of 4 over 6 styles: the first 6 draws are a permutation, so are the next 6."""
    cookbook = make_cookbook(sampling="stratified")
    drawn = torch.cat([cookbook.draw(4) for _ in range(3)]).tolist()
    assert sorted(drawn[:6]) == list(range(6))
    assert sorted(drawn[6:]) == list(range(6))
    assert drawn[:6] != drawn[6:]


def test_fixed_drawing_keeps_the_given_order():
    """Styles in their order, over and over."""
    cookbook = make_cookbook(sampling="fixed", selection=StyleSelection(episodes=[4, 1]))
    assert cookbook.draw(3).tolist() == [4, 1, 4]
    assert cookbook.draw(2).tolist() == [1, 4]


def test_a_style_is_kept_to_the_end_of_the_rollout_and_drawn_anew_after_it():
    """One style per environment, the same at every step; others after the rollout."""
    cookbook = make_cookbook(sampling="stratified")
    first = cookbook.active_styles(6)
    assert torch.equal(cookbook.active_styles(6), first)
    before = cookbook.active.tolist()
    cookbook.end_rollout()
    cookbook.active_styles(6)
    assert cookbook.active.tolist() != before
    assert torch.equal(first, cookbook.embedding(torch.tensor(before)))


def test_another_batch_size_within_a_rollout_is_an_error():
    """A missed reset is told instead of mixing styles up."""
    cookbook = make_cookbook()
    cookbook.active_styles(3)
    with pytest.raises(ValueError, match=r"batch of 2 .* call policy.reset"):
        cookbook.active_styles(2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"sampling": "random"}, "style_sampling='random'"),
        ({"selection": lambda: StyleSelection(episodes=[])}, r"style_episodes=\[\].*empty"),
        ({"selection": lambda: StyleSelection(episodes=[2, 6])}, r"episodes \[6\] do not exist.*0 to 5"),
    ],
)
def test_bad_options_are_named(options, message):
    """Unknown options and empty or impossible selections are refused when the cookbook is made."""
    with pytest.raises(ValueError, match=message):
        make_cookbook(**{key: make() if callable(make) else make for key, make in options.items()})


def test_untrained_styles_cannot_be_selected():
    """A selected episode that was not trained on has no style."""
    with pytest.raises(ValueError, match=r"episodes \[3\] were not in the training data"):
        make_cookbook(trained=[0, 1], selection=StyleSelection(episodes=[1, 3])).draw(1)
    with pytest.raises(ValueError, match="no style has been trained"):
        make_cookbook(trained=[]).draw(1)


def test_a_request_is_served_in_order_and_then_forgotten():
    """Over and over, whatever the sampling and the selection, rollout by rollout."""
    cookbook = make_cookbook(trained=[0, 2, 5])
    with cookbook.requested(StyleRequest([5, 0])):
        drawn = []
        for _ in range(2):
            cookbook.end_rollout()
            style = cookbook.active_styles(3)
            drawn.append(cookbook.active.tolist())
            torch.testing.assert_close(style, cookbook.embedding(cookbook.active))
    assert drawn == [[5, 0, 5], [0, 5, 0]]
    assert cookbook.asked is None
    with pytest.raises(ValueError, match=r"episodes \[1\] were not in the training data"):
        cookbook.requested(StyleRequest([1])).__enter__()


def test_styles_that_are_no_episodes_can_be_requested():
    """As vectors; who looks at the active episodes finds that there are none."""
    cookbook, vectors = make_cookbook(trained=[0]), torch.randn(2, 3)
    with cookbook.requested(StyleRequest(vectors=vectors)):
        cookbook.end_rollout()
        assert torch.equal(cookbook.active_styles(3), vectors[[0, 1, 0]])
        assert torch.equal(cookbook.active_styles(3), vectors[[0, 1, 0]])
    assert cookbook.active.tolist() == [BLENDED] * 3
    with pytest.raises(ValueError, match="one of the two"):
        StyleRequest([1], vectors)
    with pytest.raises(ValueError, match="empty request"):
        StyleRequest([])


def test_a_request_changes_the_rollout_under_way_from_its_next_step():
    """Environment k takes the k-th episode asked for; the next rollouts go on with those that follow."""
    cookbook = make_cookbook()
    cookbook.active_styles(3)
    cookbook.request([5, 0])
    assert torch.equal(cookbook.active_styles(3), cookbook.embedding(torch.tensor([5, 0, 5])))
    assert torch.equal(cookbook.active_styles(3), cookbook.embedding(torch.tensor([5, 0, 5])))
    cookbook.end_rollout()
    cookbook.active_styles(3)
    assert cookbook.active.tolist() == [0, 5, 0]
    cookbook.request(2)
    cookbook.active_styles(3)
    assert cookbook.active.tolist() == [2, 2, 2]


def test_a_request_before_the_first_step_holds_from_it():
    """There is nothing to change yet."""
    cookbook = make_cookbook()
    cookbook.request(4)
    cookbook.active_styles(2)
    assert cookbook.active.tolist() == [4, 4]


def test_vectors_can_be_requested_in_a_rollout():
    """Styles that are no episode's, and then an episode's again."""
    cookbook, vectors = make_cookbook(), torch.randn(2, 3)
    cookbook.active_styles(3)
    cookbook.request(vectors)
    assert torch.equal(cookbook.active_styles(3), vectors[[0, 1, 0]])
    cookbook.request(vectors[1])
    assert torch.equal(cookbook.active_styles(3), vectors[[1, 1, 1]])
    cookbook.request(3)
    assert torch.equal(cookbook.active_styles(3), cookbook.embedding(torch.tensor([3, 3, 3])))


def test_without_a_request_the_rollout_ends_as_it_is_and_the_next_draws():
    """`request(None)` takes nothing away in mid-rollout."""
    cookbook = make_cookbook(sampling="fixed", selection=StyleSelection(episodes=[1]))
    cookbook.request(4)
    cookbook.active_styles(2)
    cookbook.request(None)
    cookbook.active_styles(2)
    assert cookbook.active.tolist() == [4, 4]
    cookbook.end_rollout()
    cookbook.active_styles(2)
    assert cookbook.active.tolist() == [1, 1]


@pytest.mark.parametrize(
    ("styles", "message"),
    [
        ([2, 6], r"episodes \[6\] do not exist"),
        (3, r"episodes \[3\] were not in the training data"),
        ([], "empty request"),
        (torch.zeros(1, 4), r"shape \[1, 4\].*have 3 dimensions"),
        ("length >", "style_filter='length >'"),
        ("length > 3", "no table of its demonstrations"),
    ],
)
def test_a_request_that_cannot_be_served_changes_nothing(styles, message):
    """It is refused when it is made, and the rollout goes on as before."""
    cookbook = make_cookbook(trained=[0, 1, 2])
    before = cookbook.active_styles(2)
    with pytest.raises(ValueError, match=message):
        cookbook.request(styles)
    assert cookbook.asked is None
    assert torch.equal(cookbook.active_styles(2), before)


def test_a_request_that_cannot_be_served_is_refused_at_every_step():
    """And does not go back to the old style in silence."""
    cookbook = StyleCookbook(6, 3, 0.1)
    cookbook.trained[:] = 1
    cookbook.select([1])
    cookbook.active_styles(2)
    cookbook.drawing.sampling = "scene"  # nothing is known of how demonstrations began
    cookbook.request(StyleSelection([3]))
    for _ in range(2):
        with pytest.raises(ValueError, match="scene"):
            cookbook.active_styles(2)


def test_requested_styles_have_the_styles_type():
    """Also those that come from NumPy as float64, when a task then names a filter."""
    cookbook = StyleCookbook(6, 3, 0.1)
    cookbook.trained[:] = 1
    cookbook.request(torch.zeros(2, 3, dtype=torch.float64))
    assert cookbook.active_styles(2).dtype == torch.float32
