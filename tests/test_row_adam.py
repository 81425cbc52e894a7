"""Adam that steps over the rows that move: the same as Adam over all, at the cost of those rows."""

import copy
import pickle

import pytest
import torch
from torch import nn

from lerobot_swr.policies.optimizer_swr import FusedAdamConfig
from lerobot_swr.policies.row_adam import RowAdam, SettlingAdam

ROWS, DIM = 300, 3


class Model(nn.Module):
    """An embedding of many rows, and a layer."""

    def __init__(self):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.table = nn.Parameter(torch.randn(ROWS, DIM, generator=generator))
        self.layer = nn.Parameter(torch.randn(DIM, generator=generator))

    def loss(self, rows: torch.Tensor, sparse: bool) -> torch.Tensor:
        """Some loss of some rows."""
        values = nn.functional.embedding(rows, self.table, sparse=sparse)
        return ((values @ self.layer - rows / ROWS) ** 2).mean()


def make(by_rows: bool, **options):
    model = Model()
    groups = [{"params": [model.layer]}, {"params": [model.table], "lr": 5e-2}]
    if by_rows:
        groups[1]["by_rows"] = True
    make_optimizer = RowAdam if by_rows else torch.optim.Adam
    return model, make_optimizer(groups, lr=1e-2, **options)


def train(model, optimizer, steps: range) -> None:
    """Four rows a step, some of them twice, some often and some once."""
    for step in steps:
        generator = torch.Generator().manual_seed(step)
        rows = torch.randint(ROWS, (4,), generator=generator)
        rows[1] = rows[0] if step % 5 == 0 else step % 7
        for group in optimizer.param_groups:
            group["lr"] *= 0.998  # a schedule
        model.loss(rows, model.table.grad is not None).backward()
        optimizer.step()
        optimizer.zero_grad()


@pytest.mark.parametrize("betas", [(0.9, 0.999), (0.0, 0.99), (0.99, 0.9999)])
def test_rows_move_as_under_adam(betas):
    """After 400 steps, up to a thousandth of how far they moved; other parameters to the bit at first."""
    (rows, by_rows), (dense, adam) = make(True, betas=betas), make(False, betas=betas)
    start = dense.table.detach().clone()
    train(rows, by_rows, range(2))
    train(dense, adam, range(2))
    assert torch.equal(rows.layer, dense.layer)
    train(rows, by_rows, range(2, 400))
    train(dense, adam, range(2, 400))
    moved = (dense.table - start).abs()
    assert (moved > 0).all(dim=1).sum() > 250
    torch.testing.assert_close(rows.table, dense.table, rtol=0, atol=2e-3 * float(moved.detach().max()))
    torch.testing.assert_close(rows.layer, dense.layer, rtol=1e-3, atol=1e-4)


def test_a_step_looks_at_the_rows_that_move_alone(monkeypatch):
    """Those of the last 66 steps, in which 99.9 % of a gradient's movement is done."""
    model, optimizer = make(True)
    sizes, fused = [], torch._fused_adam_

    def count(params, *others, **options):
        sizes.append(params[0].shape)
        fused(params, *others, **options)

    monkeypatch.setattr(torch, "_fused_adam_", count)
    for step in range(200):
        model.loss(torch.tensor([step]), True).backward()
        optimizer.step()
        optimizer.zero_grad()
    rows = [shape[0] for shape in sizes if len(shape) == 2]
    assert rows[:3] == [1, 2, 3]
    assert set(rows[66:]) == {66}
    assert model.table.grad.eq(0).all()


def test_a_resumed_optimizer_goes_on_bit_for_bit():
    """From its saved state, taken while some rows move, some rest and some never moved."""
    (whole, optimizer), (resumed, other) = make(True), make(True)
    train(whole, optimizer, range(150))
    state = copy.deepcopy(optimizer.state_dict())
    resumed.load_state_dict(whole.state_dict())
    other.load_state_dict(state)
    train(whole, optimizer, range(150, 300))
    train(resumed, other, range(150, 300))
    assert torch.equal(whole.table, resumed.table)
    assert torch.equal(whole.layer, resumed.layer)


def test_settled_states_are_adams_and_go_on_under_either():
    """A run may change between this optimizer and Adam, in both directions."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    train(rows, by_rows, range(150))
    train(dense, adam, range(150))
    by_rows.settle()
    settled, exact = by_rows.state[rows.table], adam.state[dense.table]
    assert settled.keys() == exact.keys()
    for key in settled:
        torch.testing.assert_close(settled[key], exact[key], rtol=0, atol=2e-3 * float(exact[key].max()))
    (rows, by_rows), (dense, _) = make(True), (dense, adam)
    rows.load_state_dict(dense.state_dict())
    by_rows.load_state_dict(copy.deepcopy(adam.state_dict()))
    train(rows, by_rows, range(150, 300))
    train(dense, adam, range(150, 300))
    torch.testing.assert_close(rows.table, dense.table, rtol=0, atol=2e-3)


def test_dense_gradients_move_all_rows():
    """For instance those that several processes exchange: then it is Adam to rounding."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    for step in range(80):
        for model, optimizer in ((rows, by_rows), (dense, adam)):
            model.loss(torch.tensor([step % 7, 2 * step]), False).backward()
            optimizer.step()
            optimizer.zero_grad()
    torch.testing.assert_close(rows.table, dense.table, rtol=1e-5, atol=1e-6)


def test_a_run_goes_on_under_adam_and_comes_back():
    """What rows saved, Adam goes on from (weight decay or a second process), and rows again from Adam's."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    for model, optimizer in ((rows, by_rows), (dense, adam)):
        train(model, optimizer, range(150))
    options = {"lr": 1e-2, "betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 1e-9, "grad_clip_norm": 0.0}
    groups = [{"params": [rows.layer]}, {"params": [rows.table], "by_rows": True}]
    between = FusedAdamConfig(**options).build(groups)
    assert isinstance(between, SettlingAdam)
    between.load_state_dict(copy.deepcopy(by_rows.state_dict()))
    for name, exact in adam.state[dense.table].items():
        close = {"rtol": 0, "atol": 2e-3 * float(exact.max())}
        torch.testing.assert_close(between.state[rows.table][name], exact, **close)
    rows.table.grad = None
    for model, optimizer in ((rows, between), (dense, adam)):
        train(model, optimizer, range(150, 250))
    assert "moved" not in between.state[rows.table]
    again = RowAdam([{"params": [rows.layer]}, {"params": [rows.table], "by_rows": True}], lr=1e-2)
    again.load_state_dict(copy.deepcopy(between.state_dict()))
    for model, optimizer in ((rows, again), (dense, adam)):
        train(model, optimizer, range(250, 350))
    torch.testing.assert_close(rows.table, dense.table, rtol=0, atol=4e-3)


@pytest.mark.parametrize(("dtype", "kind"), [(torch.float32, RowAdam), (torch.bfloat16, SettlingAdam)])
def test_rows_are_stepped_alone_where_numpy_can_read_them(dtype, kind):
    """Elsewhere all rows are."""
    options = {"lr": 1e-2, "betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0.0, "grad_clip_norm": 0.0}
    table = nn.Parameter(torch.ones(ROWS, DIM, dtype=dtype))
    optimizer = FusedAdamConfig(**options).build([{"params": [table], "by_rows": True}])
    assert type(optimizer) is kind
    nn.functional.embedding(torch.tensor([3]), table, sparse=table.grad is not None).sum().backward()
    optimizer.step()
    assert (table < 1).any(dim=1).nonzero().flatten().tolist() == [3]


def test_a_frozen_embedding_stays_and_may_be_thawed():
    """As adapters freeze what they do not train."""
    model, _ = make(False)
    model.table.requires_grad_(False)
    optimizer = RowAdam([{"params": [model.layer]}, {"params": [model.table], "by_rows": True}], lr=1e-2)
    before = model.table.clone()
    for thawed in (False, True):
        model.table.requires_grad_(thawed)
        optimizer.zero_grad()
        model.loss(torch.tensor([1, 2]), thawed).backward()
        optimizer.step()
        changed = (model.table != before).any(dim=1)
        assert changed.nonzero().flatten().tolist() == ([1, 2] if thawed else [])


def test_an_embedding_that_is_frozen_in_mid_run_stays():
    """Whatever moved before; thawed it goes on as under Adam."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    for model, optimizer in ((rows, by_rows), (dense, adam)):
        train(model, optimizer, range(20))
        optimizer.zero_grad()
        before = model.table.detach().clone()
        model.table.requires_grad_(False)
        optimizer.step()
        assert torch.equal(model.table, before)
        model.table.requires_grad_(True)
        train(model, optimizer, range(20, 100))
    torch.testing.assert_close(rows.table, dense.table, rtol=0, atol=2e-3)


def test_a_state_that_others_empty_begins_anew():
    """Nothing of what moved before comes back."""
    model, optimizer = make(True)
    train(model, optimizer, range(20))
    optimizer.state.clear()
    optimizer.zero_grad()
    before = model.table.detach().clone()
    model.loss(torch.tensor([5]), True).backward()
    optimizer.step()
    assert (model.table != before).any(dim=1).nonzero().flatten().tolist() == [5]
    assert optimizer.state_dict()["state"][1]["exp_avg"].any(dim=1).nonzero().flatten().tolist() == [5]


def test_scaled_gradients_are_scaled_back_and_infinite_ones_passed_over():
    """By torch's `GradScaler`: as Adam."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    for model, optimizer in ((rows, by_rows), (dense, adam)):
        scaler = torch.amp.GradScaler("cpu", init_scale=1024.0)
        for step in range(6):
            sparse = getattr(model.table, "by_rows", False) and model.table.grad is not None
            loss = model.loss(torch.tensor([step % 3, 7]), sparse) * (float("inf") if step == 2 else 1)
            scaler.scale(loss).backward()
            scaler.step(optimizer)
            scaler.update()
            optimizer.zero_grad()
    assert rows.table.isfinite().all()
    torch.testing.assert_close(rows.table, dense.table, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("by_hand", [True, False])
def test_gradients_that_come_in_other_ways_count(by_hand):
    """Set by hand, or computed from what was seen before the model forgot its gradients."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    for model, optimizer in ((rows, by_rows), (dense, adam)):
        sparse = getattr(model.table, "by_rows", False)
        loss = model.loss(torch.tensor([4, 9]), sparse and not by_hand)
        model.zero_grad()
        if by_hand:
            (model.table.grad,) = torch.autograd.grad(loss, [model.table])
        else:
            loss.backward()
        optimizer.step()
        optimizer.zero_grad()
    torch.testing.assert_close(rows.table, dense.table, rtol=1e-5, atol=1e-6)
    assert rows.table.grad.eq(0).all()


@pytest.mark.parametrize("set_to_none", [True, False])
def test_gradients_that_the_model_forgets_are_forgotten(set_to_none):
    """With ``model.zero_grad``, too, and without notes that grow from step to step."""
    (rows, by_rows), (dense, adam) = make(True), make(False)
    for step in range(300):
        for model, optimizer in ((rows, by_rows), (dense, adam)):
            sparse = getattr(model.table, "by_rows", False) and model.table.grad is not None
            model.loss(torch.tensor([step % 7, step % 50]), sparse).backward()
            optimizer.step()
            model.zero_grad(set_to_none)
    torch.testing.assert_close(rows.table, dense.table, rtol=0, atol=4e-3)
    assert sum(map(len, by_rows._touched[rows.table])) <= 2 * ROWS


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda pair: pickle.loads(pickle.dumps(pair))])
def test_a_copy_goes_on_as_the_original(copied):
    """Model and optimizer copied together, or written and read, in the middle of a run."""
    model, optimizer = make(True)
    train(model, optimizer, range(100))
    other, copied_optimizer = copied((model, optimizer))
    copied_optimizer.zero_grad()
    for pair in ((model, optimizer), (other, copied_optimizer)):
        train(*pair, range(100, 200))
    assert torch.equal(model.table, other.table)
