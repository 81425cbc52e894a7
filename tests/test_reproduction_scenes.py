"""The suite scenes: measured, and drawn as a table."""

import json

import pytest
from conftest import save_checkpoint
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import make_policy
from lerobot.policies.factory import make_policy_config

from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.reproduction.demonstrations import prepare
from lerobot_swr.reproduction.execution import run_cells
from lerobot_swr.reproduction.report import write_results_report
from lerobot_swr.reproduction.suites import suite_cells
from lerobot_swr.reproduction.training import checkpoint_folder
from lerobot_swr.run_context import running
from lerobot_swr.whole_files import write_whole


@pytest.mark.parametrize("policy", ["bc", "zbc"])
def test_own_and_new_scenes_are_measured_and_tabled(tmp_path, store, settings, policy):
    """From fresh checkpoints: a row with success and fidelity in both kinds of scenes, and blind replay."""
    write_dataset(get_recipe("scenes_maze-two_ways").with_episodes(6), tmp_path / "two_ways", seed=0)
    meta = LeRobotDatasetMetadata("local/two_ways", root=tmp_path / "two_ways")
    demos = prepare("two_ways", tmp_path, store)
    settings.policies, settings.n_rollouts, settings.seeds = [policy], 6, 1
    cells = suite_cells("scenes", settings, [demos])
    for cell in cells:
        if cell.kind == "train":
            options = {"backbone": MLPConfig(16, 3), "device": "cpu", "push_to_hub": False}
            with running(DatasetConfig("local/two_ways")):
                made = make_policy(make_policy_config(policy, **options), ds_meta=meta)
            save_checkpoint(made, meta, checkpoint_folder(cell, store, 0))
            store.write(cell, {}, 0.0)
    assert run_cells(cells, store, {demos.name: demos}, jobs=1) == []
    measured = {c.labels.condition: store.read(c) for c in cells if c.kind == "evaluate"}
    protocol = "uniform" if policy == "bc" else "stratified"
    columns = {name: result["rollouts"]["0"][protocol] for name, result in measured.items()}
    assert columns["own scenes"]["replay_success"] == columns["own scenes"]["replay_match"] == [1] * 6
    assert all(match in (0, 1) for match in columns["new scenes"]["match"])
    if policy == "zbc":
        assert sorted(columns["own scenes"]["style"]) == list(range(6))
    manifest = {
        "suite": "scenes",
        "command": "lerobot-swr-reproduce --suite=scenes",
        "datasets": {demos.name: store.result_path(demos.cell).name},
        "cells": [store.result_path(one).name for one in cells],
    }
    write_whole(store.root / "suites" / "scenes.json", json.dumps(manifest))
    page = write_results_report(store.root).read_text()
    assert "<h2>Scenes: two_ways" in page
    assert f"{policy} hidden_dim=16" in page
