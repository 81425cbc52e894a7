"""The statistics by which LeRobot normalises are compared with the data before they are believed."""

import json
import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config
from lerobot.scripts import lerobot_edit_dataset
from odd_datasets import ACTION, PLAIN, STATE, arc, arcs, edit_json, feature, metadata, write

from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig

QUANTILES = {"STATE": "QUANTILES", "ACTION": "QUANTILES"}
EDGES = {"STATE": "MIN_MAX", "ACTION": "MIN_MAX"}


def make(root, policy_type="zbc", mapping=None):
    """A small policy on a dataset, and the statistics that it leaves LeRobot to normalise with."""
    meta = metadata(root)
    options = {} if mapping is None else {"normalization_mapping": mapping}
    if policy_type in ("bc", "zbc"):
        options |= {"backbone": MLPConfig(8, 1)}
    policy = make_policy(
        make_policy_config(policy_type, device="cpu", push_to_hub=False, **options), ds_meta=meta
    )
    return policy, meta.stats


def change_statistics(root, change):
    """Change stats.json in place."""
    edit_json(root / "meta/stats.json", change)


def scaled(stats):
    """The numbers of another recording, of twice the size."""
    for key in (STATE, ACTION):
        for name in stats[key]:
            stats[key][name] = (2 * np.array(stats[key][name])).tolist()


FAULTS = {
    "another recording's": (scaled, r"dimension 0 of feature '[a-z.]+' has mean .* deviation"),
    "NaN": (
        lambda stats: stats[ACTION].update(mean=[0.0, np.nan]),
        r"mean of feature 'action' is not finite",
    ),
    "null": (lambda stats: stats[ACTION].update(std=[None, 1.0]), r"std of feature 'action' is not finite"),
    "a zero": (
        lambda stats: stats[STATE]["std"].__setitem__(1, 0.0),
        r"dimension 1 .*'observation.state'.* 0,",
    ),
    "a shifted mean": (lambda stats: stats[STATE]["mean"].__setitem__(0, 1.0), r"dimension 0 .* mean 1 "),
    "another shape": (
        lambda stats: stats[ACTION].update(mean=[0.0]),
        r"mean of feature 'action' has shape \[1\]",
    ),
    "no feature": (lambda stats: stats.pop(ACTION), r"has no mean and no std of feature 'action'"),
    "no deviation": (lambda stats: stats[STATE].pop("std"), r"has no std of feature 'observation.state'"),
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("policy_type", ["bc", "beso"])
def test_statistics_that_are_not_those_of_the_data_are_refused(copied_arcs, fault, policy_type):
    """Feature and dimension are named, with both numbers and the command that computes them anew."""
    change, expected = FAULTS[fault]
    change_statistics(copied_arcs, change)
    with pytest.raises(ValueError, match=rf"{expected}.*lerobot-edit-dataset .*recompute_stats"):
        make(copied_arcs, policy_type)


def test_the_repair_that_is_named_works(copied_arcs, monkeypatch):
    """Without stats.json at all: LeRobot's command, as the message gives it, makes the dataset trainable."""
    (copied_arcs / "meta/stats.json").unlink()
    with pytest.raises(ValueError, match="recompute_stats") as refusal:
        make(copied_arcs)
    command = str(refusal.value).split("anew: ")[1].split()
    monkeypatch.setattr(sys, "argv", command)
    lerobot_edit_dataset.main()
    _, stats = make(copied_arcs)
    states = np.concatenate([[arc(i, t, n) for t in range(n)] for i, n in enumerate((6, 8, 10, 12))])
    np.testing.assert_allclose(stats[STATE]["std"], states.std(axis=0), rtol=1e-4)


def test_right_statistics_are_left_as_they_are(plain_arcs):
    """Mean and standard deviation are, to the last digit, those of stats.json."""
    written = json.loads((plain_arcs / "meta/stats.json").read_text())
    _, stats = make(plain_arcs)
    for key in (STATE, ACTION):
        for name in ("mean", "std"):
            np.testing.assert_array_equal(stats[key][name], written[key][name])


def test_statistics_may_be_checked_again(tmp_path):
    """Several seeds share a dataset's metadata: what one policy has prepared suits the next."""
    features = {**PLAIN, "observation.grid": feature(2, 2), "observation.still": feature(2)}
    root = write(
        tmp_path / "data",
        features,
        lambda i, t, n: {
            **arcs(i, t, n),
            "observation.grid": np.array([[t, 1], [i, 1]], np.float32),
            "observation.still": np.array([0.3, t], np.float32),
        },
    )
    meta = metadata(root)
    for _ in range(2):
        make_policy(make_policy_config("bc", backbone=MLPConfig(8, 1), device="cpu"), ds_meta=meta)
    assert meta.stats["observation.still"]["std"][0] == 1
    np.testing.assert_array_equal(meta.stats["observation.grid"]["std"][[1, 3]], 1)


def test_what_lerobots_rounding_spoils_is_taken_from_the_data(tmp_path, caplog):
    """A joint at 100 that moves by thousandths: a difference of squares in float32 gives it any deviation."""
    features = {**PLAIN, "observation.joint": feature(1)}
    values = []

    def frame(i, t, n):
        values.append(100 + 1e-3 * np.sin(t + i))
        return {**arcs(i, t, n), "observation.joint": np.array(values[-1:], np.float32)}

    root = write(tmp_path / "data", features, frame)
    change_statistics(root, lambda stats: stats["observation.joint"].update(std=[0.0]))
    with caplog.at_level(logging.INFO):
        _, stats = make(root)
    np.testing.assert_allclose(
        stats["observation.joint"]["std"], np.float32(values).std(dtype=float), rtol=1e-6
    )
    assert "rounding" in caplog.text


@pytest.mark.parametrize("mapping", [EDGES, QUANTILES])
def test_other_normalisations_are_checked_by_what_they_need(copied_arcs, mapping):
    """Least and largest values, or quantiles: right ones pass, those of another recording do not."""
    make(copied_arcs, mapping=mapping)
    change_statistics(copied_arcs, lambda stats: (stats[STATE].pop("mean"), scaled(stats)))
    with pytest.raises(ValueError, match=r"dimension 0 of feature '.*the data go from .*recompute_stats"):
        make(copied_arcs, mapping=mapping)


def test_quantiles_that_coincide_are_refused(copied_arcs):
    """LeRobot would divide by 1e-8; computing them anew does not help, another normalisation does."""
    change_statistics(copied_arcs, lambda stats: stats[ACTION].update(q01=[0.0, 0.0], q99=[0.0, 1.0]))
    with pytest.raises(ValueError, match=r"q01 and q99 of dimension 0 of feature 'action' are equal"):
        make(copied_arcs, mapping=QUANTILES)


def test_statistics_that_nothing_needs_are_not_looked_at(copied_arcs):
    """Without normalisation, or of features that the policy does not use."""
    change_statistics(copied_arcs, lambda stats: stats.clear())
    make(copied_arcs, mapping={"STATE": "IDENTITY", "ACTION": "IDENTITY"})


def test_the_documented_computation_does_for_grids_what_lerobots_command_does_not(tmp_path):
    """The lines of docs/datasets.md, on a dataset whose statistics are gone: as LeRobot wrote them."""
    features = {**PLAIN, "observation.grid": feature(2, 3), "observation.on": feature(1, dtype="bool")}
    root = write(
        tmp_path / "data",
        features,
        lambda i, t, n: {
            **arcs(i, t, n),
            "observation.grid": np.outer([1, t], [i, 1, t]).astype(np.float32),
            "observation.on": np.array([t % 2 == 1]),
        },
    )
    written = metadata(root).stats
    (root / "meta/stats.json").unlink()
    with pytest.raises(ValueError, match=r"has no mean .* compute the statistics anew: see docs/datasets.md"):
        make(root)
    page = (Path(__file__).parent.parent / "docs/datasets.md").read_text()
    exec(page.split("```python\n")[1].split("```")[0].replace("DATASET", str(root)), {})
    make(root)
    for key in features:
        for name in ("mean", "std", "min", "max"):
            np.testing.assert_allclose(metadata(root).stats[key][name], written[key][name], rtol=1e-5)
