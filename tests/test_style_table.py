"""The demonstrations' table: its columns, its place in checkpoints, and the selections made with it."""

import json
import logging

import numpy as np
import pytest
import torch
from conftest import make_batch, save_checkpoint, train_flags
from draccus.utils import ParsingError
from lerobot.configs import PreTrainedConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.policies import PreTrainedPolicy, make_policy

from lerobot_swr.behavior_rules import dataset_behavior_rule
from lerobot_swr.cli import styles as styles_command
from lerobot_swr.demos.catalog import RECIPES
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.demos.maze2d import _recipe, steady
from lerobot_swr.policies.modeling_swr import ZBCPolicy
from lerobot_swr.sharing.policy_card import PICTURE
from lerobot_swr.similarity.distances import pairwise_distances
from lerobot_swr.styles.selection import StyleSelection
from lerobot_swr.styles.table import TABLE_FILE, StyleTable, load_style_table, make_style_table
from lerobot_swr.trajectories import Trajectories, load_trajectories


def last_y(episode) -> float:
    """A user metric."""
    return episode["observation.state"][-1, 1]


def failing(episode):
    """A metric of a feature that is not there."""
    return episode["observation.x"].sum()


def broken(episode) -> float:
    """A user metric that is not finite."""
    return float("nan")


@pytest.fixture
def table() -> StyleTable:
    """Four demonstrations on a line, with rewards, successes and two behaviours."""
    states = [np.array(s, dtype=np.float32)[:, None] for s in ([0, 3, 4], [0, 1], [0, 3, 5, 5], [9])]
    lengths = np.array([3, 2, 4, 1])
    columns = {
        "observation.state": np.concatenate(states),
        "next.reward": np.arange(10, dtype=np.float32)[:, None],
        "next.success": np.array([0, 0, 1, 0, 0, 0, 0, 0, 1, 0], dtype=np.float32)[:, None],
    }
    trajectories = Trajectories(lengths, columns, fps=2, name="line", tasks=("a", "a", "b", "b"))
    neighbours = np.array([[1, 3, 2], [0, 3, 2], [3, 1, 0], [2, 1, 0]])
    return make_style_table(
        trajectories, neighbours, lambda e: "far" if e["observation.state"][-1, 0] > 4 else "near"
    )


def test_columns_are_what_their_names_say(table):
    """Every column against values computed by hand."""
    assert table.columns == {
        "episode": [0, 1, 2, 3],
        "length": [3, 2, 4, 1],
        "duration": [1.5, 1.0, 2.0, 0.5],
        "path_length": [4.0, 1.0, 5.0, 0.0],
        "mean_speed": [4.0, 2.0, pytest.approx(10 / 3), 0.0],
        "return": [3.0, 7.0, 26.0, 9.0],
        "success": [True, False, True, False],
        "first_0": [0.0, 0.0, 0.0, 9.0],
        "last_0": [4.0, 1.0, 5.0, 9.0],
        "task": ["a", "a", "b", "b"],
        "behavior": ["near", "near", "far", "far"],
    }


def test_neighbours_are_nearest_by_nu(small_maze_meta, make_tiny_policy):
    """The order is that of the distances as they are defined; the neighbours are all others."""
    table = make_tiny_policy("zbc").styles.table
    keys = ["observation.environment_state", "observation.state"]
    distances = pairwise_distances(load_trajectories(small_maze_meta, keys).states(keys))
    for i, neighbours in enumerate(table.neighbours.tolist()):
        assert sorted(neighbours) == [j for j in range(6) if j != i]
        assert (np.diff(distances[i, neighbours]) >= -1e-12).all()


def test_a_saved_table_comes_back_as_it_was(table, tmp_path):
    """Kinds of columns, neighbours and filters; of one demonstration alone, too; no other file is left."""
    named = table.with_filter("näher", "behavior == 'near'")
    alone = StyleTable({name: values[:1] for name, values in table.columns.items()}, np.empty((1, 0)))
    for one in (named, alone):
        one.save(tmp_path)
        found = load_style_table(tmp_path)
        assert found.columns == one.columns
        assert [type(values[0]) for values in found.columns.values()] == [
            type(values[0]) for values in one.columns.values()
        ]
        np.testing.assert_array_equal(found.neighbours, one.neighbours)
        assert found.filters == one.filters
        assert [path.name for path in tmp_path.iterdir()] == [TABLE_FILE]


def test_table_and_picture_are_pushed_to_the_hub_before_the_policy(checkpoint, monkeypatch):
    """LeRobot uploads neither, and a remote run ends when it says that the policy is there."""
    policy, pushed = reload(checkpoint), []
    policy.config.repo_id = "user/policy"

    def keep(api, path_or_fileobj, path_in_repo, repo_id):
        content = path_or_fileobj if isinstance(path_or_fileobj, bytes) else path_or_fileobj.read_bytes()
        pushed.append((repo_id, path_in_repo, content))

    monkeypatch.setattr("huggingface_hub.HfApi.create_repo", lambda api, **_: None)
    monkeypatch.setattr("huggingface_hub.HfApi.upload_file", keep)
    monkeypatch.setattr(PreTrainedPolicy, "push_model_to_hub", lambda *_, **__: pushed.append("policy"))
    policy.push_model_to_hub(None)
    assert pushed == [
        *(("user/policy", name, (checkpoint / name).read_bytes()) for name in (TABLE_FILE, PICTURE)),
        "policy",
    ]


def test_missing_neighbours_are_nobodys(table):
    """Rows that were added later may have more neighbours than those before them."""
    more = StyleTable({name: values[:1] for name, values in table.columns.items()}, np.array([[2, 0, 1, 3]]))
    both = table.extended(more)
    assert both.neighbours.tolist() == [*([*row, -1] for row in table.neighbours.tolist()), [2, 0, 1, 3]]
    trained = np.ones(5, dtype=bool)
    assert StyleSelection(like=0, neighbours=9).resolve(trained, both) == [0, 1, 3, 2]


def test_a_selection_keeps_what_all_conditions_allow(table):
    """Filter, list and neighbours intersect; the list's and the neighbours' order is kept."""
    trained = np.array([True, True, True, False])
    cases = [
        (StyleSelection(), [0, 1, 2]),
        (StyleSelection(filter="behavior == 'near'"), [0, 1]),
        (StyleSelection(episodes=[2, 0]), [2, 0]),
        (StyleSelection(episodes=[2, 0], filter="length == 3"), [0]),
        (StyleSelection(like=2, neighbours=1), [2, 1]),  # 3 is nearer, but has no style
        (StyleSelection(like=2, neighbours=0), [2]),
        (StyleSelection(like=2, neighbours=2, filter="task == 'a'"), [1, 0]),
    ]
    for selection, expected in cases:
        assert selection.resolve(trained, table) == expected


def test_empty_selections_and_missing_tables_are_explained(table):
    """The message names the flags, the known columns with their ranges, or how to get a table."""
    trained = np.array([True, True, True, False])
    with pytest.raises(ValueError, match=r"style_filter='length > 9': no style is left .* length 2 to 4;"):
        StyleSelection(filter="length > 9").resolve(trained, table)
    with pytest.raises(ValueError, match=r"style_like=1: .* no table .* lerobot-swr-styles CHECKPOINT"):
        StyleSelection(like=1).resolve(trained, None)
    with pytest.raises(ValueError, match=r"style_like=\[7\]: episodes \[7\] do not exist"):
        StyleSelection(like=7).check_episodes(4)
    with pytest.raises(ValueError, match="style_neighbours=-1"):
        StyleSelection(neighbours=-1)


def trained(policy: ZBCPolicy) -> ZBCPolicy:
    """The policy after one batch with every episode."""
    policy.train()
    policy.forward(make_batch())
    return policy.eval()


def reload(folder, **options) -> ZBCPolicy:
    """The checkpoint with inference flags."""
    flags = [f"--{key}={value}" for key, value in options.items()]
    config = PreTrainedConfig.from_pretrained(folder, cli_overrides=flags)
    return ZBCPolicy.from_pretrained(folder, config=config)


def drawn(policy: ZBCPolicy, n: int = 60, **batch) -> set[int]:
    """The episodes whose styles a rollout of n environments uses."""
    policy.reset()
    policy.select_action({**make_batch(n), **batch})
    return set(policy.styles.active.tolist())


@pytest.fixture
def checkpoint(make_tiny_policy, small_maze_meta, tmp_path):
    """Folder of a tiny trained policy's checkpoint."""
    policy = trained(make_tiny_policy("zbc", style_metrics=f"{__name__}:last_y"))
    return save_checkpoint(policy, small_maze_meta, tmp_path / "checkpoint")


def test_the_table_travels_with_the_checkpoint_and_flags_select_styles(checkpoint):
    """Own datasets are labelled without a flag; metrics are columns; each flag does what it says."""
    policy = reload(checkpoint)
    table = policy.styles.table
    behavior = table.columns["behavior"]
    assert sorted(behavior) == ["10"] * 4 + ["20"] * 2
    assert table.columns["last_y"] == table.columns["last_1"]
    left = {i for i in range(6) if behavior[i] == "10"}
    assert drawn(policy) == set(range(6))
    assert drawn(reload(checkpoint, style_filter="behavior == '10'")) == left
    assert drawn(reload(checkpoint, style_episodes="[3,1]")) == {1, 3}
    assert drawn(reload(checkpoint, style_like=2, style_neighbours=2)) == {
        2,
        *table.neighbours[2, :2].tolist(),
    }
    assert policy.styles.filter("behavior == '10'") == sorted(left)
    policy.styles.select([4])
    assert drawn(policy) == {4}
    policy.styles.select(None)
    assert drawn(policy) == set(range(6))


def test_bad_flags_fail_when_the_checkpoint_is_loaded(checkpoint):
    """Not at the first action."""
    with pytest.raises(ValueError, match="unknown name 'lenght'; known: episode 0 to 5; length"):
        reload(checkpoint, style_filter="lenght > 7")
    with pytest.raises(ValueError, match="no style is left"):
        reload(checkpoint, style_filter="length > 7000")
    with pytest.raises(ParsingError) as error:
        reload(checkpoint, style_filter="length >")
    assert "style_filter='length >'" in str(error.value.__cause__)


def test_a_task_string_selects_the_named_filter_per_environment(checkpoint):
    """Environments whose task is a filter's name draw from it, the others from all; the flags still hold."""
    reload(checkpoint).styles.table.with_filter("left", "behavior == '10'").save(checkpoint)
    policy = reload(checkpoint)
    left = {i for i, label in enumerate(policy.styles.table.columns["behavior"]) if label == "10"}
    assert drawn(policy, task=["left"] * 60) == left
    assert drawn(policy, task="left") == left
    assert drawn(policy, task=["something else"] * 60) == set(range(6))
    policy.reset()
    policy.select_action({**make_batch(60), "task": ["left", "right"] * 30})
    assert set(policy.styles.active[::2].tolist()) == left
    assert set(policy.styles.active[1::2].tolist()) == set(range(6))
    with pytest.raises(ValueError, match=r"style_filter=.* task='left': no style is left"):
        drawn(reload(checkpoint, style_filter="behavior == '20'"), task=["left"] * 60)


def test_a_changed_task_takes_effect_from_the_next_step(checkpoint):
    """For the environment whose task names another filter, not for the others; text that names none keeps."""
    reload(checkpoint).styles.table.with_filter("left", "behavior == '10'").save(checkpoint)
    labels = reload(checkpoint).styles.table.columns["behavior"]
    left, (right, other) = labels.index("10"), [i for i in range(6) if labels[i] == "20"]
    policy = reload(checkpoint, style_episodes=f"[{left},{right},{other}]", style_sampling="fixed")

    def act(*tasks):
        policy.select_action({**make_batch(3), "task": list(tasks)})
        return policy.styles.active.tolist()

    policy.reset()
    assert act("walk", "walk", "walk") == [left, right, other]
    assert act("walk", "left", "walk") == [left, left, other]
    assert act("walk", "walk", "walk") == [left, left, other]
    policy.styles.request([right])
    assert act("left", "left", "left") == [right, right, right]


def test_filters_and_their_names_can_be_requested_in_a_rollout(checkpoint):
    """Styles are drawn from what matches, whatever the flags allow."""
    reload(checkpoint).styles.table.with_filter("left", "behavior == '10'").save(checkpoint)
    policy = reload(checkpoint, style_episodes="[4]")
    labels = policy.styles.table.columns["behavior"]
    policy.reset()
    for asked, expected in (("left", "10"), ("behavior == '20'", "20"), (StyleSelection(like=0), None)):
        policy.select_action(make_batch(60))
        policy.styles.request(asked)
        policy.select_action(make_batch(60))
        matching = {i for i, label in enumerate(labels) if expected in (None, label)}
        assert set(policy.styles.active.tolist()) == matching


def test_without_named_filters_the_drawing_is_as_it_was(checkpoint):
    """Task strings that name no filter leave the random numbers alone."""
    policy = reload(checkpoint)
    torch.manual_seed(3)
    expected = torch.randint(6, (20,))
    torch.manual_seed(3)
    assert torch.equal(policy.styles.draw(20, ["walk"] * 20), expected)


def test_a_blend_is_the_weighted_mean_of_two_styles(checkpoint):
    """Z = (1 - share) z_i + share z_j, for every environment; its active episode is no episode's."""
    policy = reload(checkpoint, style_interpolate="[1,4,0.25]")
    weight = policy.styles.embedding.weight
    style = policy.styles.active_styles(3)
    assert torch.allclose(style, (0.75 * weight[1] + 0.25 * weight[4]).expand(3, -1))
    assert policy.styles.active.tolist() == [-1, -1, -1]
    with pytest.raises(ValueError, match="share must lie in 0 to 1"):
        policy.styles.interpolate(1, 4, 1.5)
    with pytest.raises(ParsingError) as error:
        reload(checkpoint, style_interpolate="[1,4,0.25]", style_filter="length > 1")
    assert "fixes the style: leave out" in str(error.value.__cause__)


def test_an_older_checkpoint_loads_without_its_table_and_gets_one_by_command(
    checkpoint, small_maze, run_command, caplog, capsys
):
    """A message tells the command; after it filters work."""
    (checkpoint / TABLE_FILE).unlink()
    with caplog.at_level(logging.WARNING):
        policy = reload(checkpoint)
    assert "no table of its demonstrations" in caplog.text
    assert drawn(policy) == set(range(6))
    with pytest.raises(ValueError, match="make one with lerobot-swr-styles CHECKPOINT"):
        policy.styles.filter("length > 3")
    run_command(styles_command.main, checkpoint, f"--dataset.root={small_maze}")
    assert "6 styles of 6 demonstrations" in capsys.readouterr().out
    assert len(reload(checkpoint).styles.filter("length > 3")) == 6


@pytest.mark.parametrize("policy_type", ["zbc", "wzbc"])
def test_a_table_made_anew_leaves_the_facts_of_training_alone(
    make_tiny_policy, small_maze, small_maze_meta, tmp_path, run_command, policy_type
):
    """The new metrics are noted; what config.json says of the dynamics in training stays."""
    policy = trained(make_tiny_policy(policy_type, corrective="noise"))
    folder = save_checkpoint(policy, small_maze_meta, tmp_path / "checkpoint")
    known = {**json.loads((folder / "config.json").read_text()), "inverse_horizon": 7, "inverse_r2": [0.9, 1]}
    (folder / "config.json").write_text(json.dumps(known))
    metric = f"{__name__}:last_y"
    run_command(
        styles_command.main,
        folder,
        f"--dataset.root={small_maze}",
        "--dataset.episodes=[0]",  # of which no dynamics could be learned
        f"--style_metrics={metric}",
    )
    assert json.loads((folder / "config.json").read_text()) == {**known, "style_metrics": metric}
    new = load_style_table(folder)
    assert new.columns == {**policy.styles.table.columns, "last_y": new.columns["last_1"]}
    np.testing.assert_array_equal(new.neighbours, policy.styles.table.neighbours)


def test_filters_are_previewed_named_listed_and_forgotten_by_command(checkpoint, run_command, capsys):
    """The preview counts; the name is kept with the checkpoint until it is forgotten."""
    run_command(styles_command.main, checkpoint, "--filter=behavior == '20'", "--name=right")
    assert "2 of 6 demonstrations" in capsys.readouterr().out
    assert load_style_table(checkpoint).filters == {"right": "behavior == '20'"}
    run_command(styles_command.main, checkpoint)
    assert "'right': behavior == '20'  (2 styles)" in capsys.readouterr().out
    run_command(styles_command.main, checkpoint, "--forget=right")
    assert load_style_table(checkpoint).filters == {}
    with pytest.raises(SystemExit):
        run_command(styles_command.main, checkpoint, "--filter=lenght > 3")
    assert "unknown name 'lenght'" in capsys.readouterr().err


def test_named_filters_survive_resuming(small_maze, tmp_path, lerobot_train_command):
    """`--resume=true` keeps the table and its names."""
    run = tmp_path / "run"
    lerobot_train_command(*train_flags("zbc", small_maze, run, 4, "--save_freq=2"))
    last = run / "checkpoints" / "last" / "pretrained_model"
    load_style_table(last).with_filter("short", "length < 1000").save(last)
    lerobot_train_command(f"--config_path={last}/train_config.json", "--resume=true", "--steps=6")
    assert load_style_table(run / "checkpoints" / "last" / "pretrained_model").filters == {
        "short": "length < 1000"
    }


def test_fine_tuning_on_other_data_starts_a_new_table_and_drops_the_names(checkpoint, tmp_path, caplog):
    """The old demonstrations' names mean nothing for the new ones; a message says so."""
    load_style_table(checkpoint).with_filter("short", "length < 1000").save(checkpoint)
    write_dataset(_recipe("other", "small", {"20": 3}, steady), tmp_path / "other", seed=9)
    config = PreTrainedConfig.from_pretrained(checkpoint)
    config.pretrained_path = checkpoint
    with caplog.at_level(logging.WARNING):
        tuned = make_policy(config, ds_meta=LeRobotDatasetMetadata("local/other", root=tmp_path / "other"))
    assert "dropped: short" in caplog.text
    assert tuned.styles.table.filters == {}
    assert tuned.styles.table.columns["behavior"] == ["20"] * 3


def test_bad_metrics_and_damaged_tables_are_named(make_tiny_policy, checkpoint):
    """A metric that is not finite, one that does not exist, a truncated file, another checkpoint's."""
    with pytest.raises(ValueError, match="style_metrics: 'broken' of episode 0 is nan"):
        make_tiny_policy("zbc", style_metrics=f"{__name__}:broken")
    with pytest.raises(
        ValueError, match=r"style_metrics: 'failing' fails on episode 0: KeyError\('observation.x'\)"
    ):
        make_tiny_policy("zbc", style_metrics=f"{__name__}:failing")
    with pytest.raises(ValueError, match="style_metrics='nowhere:metric'"):
        make_tiny_policy("zbc", style_metrics="nowhere:metric")
    table, content = load_style_table(checkpoint), (checkpoint / TABLE_FILE).read_bytes()
    for damaged in (content[:100], content[:-20], b"", b"{}"):
        (checkpoint / TABLE_FILE).write_bytes(damaged)
        with pytest.raises(ValueError, match="damaged table"):
            reload(checkpoint)
    columns = {name: values[:1] for name, values in table.columns.items()}
    StyleTable(columns, table.neighbours[:1]).save(checkpoint)
    with pytest.raises(ValueError, match="1 rows, the checkpoint 6 styles"):
        reload(checkpoint)


@pytest.mark.parametrize("recipe", RECIPES.values(), ids=RECIPES.keys())
def test_every_dataset_of_the_package_finds_its_own_rule(recipe):
    """By its robot_type, without a flag."""
    rule = dataset_behavior_rule(None, recipe.robot_type)
    assert type(rule) is type(recipe.behavior_rule)
    assert getattr(rule, "layout", rule) == getattr(recipe.behavior_rule, "layout", recipe.behavior_rule)
