"""Every type and shape that LeRobot reads reaches the policies as the same vectors, in either trainer."""

import numpy as np
import pyarrow as pa
import pytest
import torch
from conftest import save_checkpoint, train_flags
from lerobot.configs.default import DatasetConfig
from lerobot.datasets import LeRobotDataset
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.policies.factory import make_policy_config
from lerobot.utils.collate import lerobot_collate_fn
from odd_datasets import (
    ACTION,
    PLAIN,
    STATE,
    arc,
    arcs,
    feature,
    metadata,
    set_column,
    split_into_files,
    write,
)
from safetensors.torch import load_file

from lerobot_swr.policies.backbones.configuration_mlp import MLPConfig
from lerobot_swr.policies.vector_pipelines import FloatVectorsProcessorStep
from lerobot_swr.training.configuration_training import SeedsTrainConfig
from lerobot_swr.training.memory_dataset import MemoryDataset
from lerobot_swr.training.seed_runs import SeedRuns
from lerobot_swr.training.seed_training import _prepared_frames

SMALL = ("--policy.backbone.hidden_dim=16", "--policy.backbone.num_hidden=2", "--log_freq=5")
EXTRA = "observation.extra"


def values(i: int, t: int, n: int, shape: tuple[int, ...], dtype: str) -> np.ndarray:
    """Numbers of a type that move, each in its own way."""
    place = np.arange(1, np.prod(shape) + 1).reshape(shape)
    moving = 40 * np.sin(place * (1 + t + i)) + 50
    return (moving % 2 > 1 if dtype == "bool" else moving).astype(dtype)


KINDS = [
    *((dtype, (2,)) for dtype in ("float64", "float16", "int8", "uint8", "int16", "int64", "bool")),
    *(("float32", shape) for shape in ((1,), (1, 3), (3, 2), (2, 2, 2))),
    *((dtype, shape) for dtype in ("int64", "bool") for shape in ((1,), (2, 2))),
]


@pytest.fixture(scope="module", params=KINDS, ids=lambda kind: f"{kind[0]}{list(kind[1])}")
def odd(request, tmp_path_factory):
    """A dataset with an observation and an action of this type and shape, and the numbers in it."""
    dtype, shape = request.param
    numbers: list[np.ndarray] = []

    def frame(i, t, n):
        action = values(i, t, n, shape, dtype)
        numbers.append(action)
        return {STATE: arc(i, t, n), EXTRA: action, ACTION: action}

    described = feature(*shape, dtype=dtype)
    root = tmp_path_factory.mktemp("odd") / "data"
    write(root, {STATE: feature(2), EXTRA: described, ACTION: described}, frame)
    return root, np.stack(numbers).reshape(len(numbers), -1).astype(np.float32)


def make(root, policy_type="zbc", **options):
    """A policy on a dataset, as LeRobot makes it, with its metadata."""
    meta = metadata(root)
    config = make_policy_config(policy_type, device="cpu", push_to_hub=False, **options)
    return make_policy(config, ds_meta=meta), meta


def batch_of(root, rows, **options):
    """What LeRobot's loader hands over."""
    dataset = LeRobotDataset("local/odd", root=root, **options)
    return lerobot_collate_fn([dataset[row] for row in rows])


def test_lerobots_batches_arrive_as_normalised_vectors(odd):
    """Against the written numbers, with mean and standard deviation computed here: float32, (B, d)."""
    root, numbers = odd
    policy, meta = make(root, backbone=MLPConfig(8, 1))
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    rows = np.random.default_rng(0).permutation(len(numbers))[:7]
    batch = preprocessor(batch_of(root, rows))
    # LeRobot's statistics of a grid are over its rows together.
    shape = meta.features[EXTRA]["shape"]
    pooled = numbers.reshape(-1, shape[-1]).astype(np.float64)
    mean, std = (np.tile(value, numbers.shape[1] // shape[-1]) for value in (pooled.mean(0), pooled.std(0)))
    expected = (numbers[rows] - mean) / std
    for key in (EXTRA, ACTION):
        assert batch[key].dtype == torch.float32
        np.testing.assert_allclose(batch[key], expected, atol=2e-3, err_msg=key)
    assert policy.forward(batch)[0].isfinite()


def test_both_trainers_see_the_same_frames(odd, tmp_path):
    """What ``lerobot-swr-train`` prepares is what the preprocessor makes of LeRobot's batches, row by row."""
    root, numbers = odd
    config = SeedsTrainConfig(
        dataset=DatasetConfig("local/odd", root=str(root)),
        policy=make_policy_config("bc", backbone=MLPConfig(8, 1), device="cpu", push_to_hub=False),
        output_dir=tmp_path / "run",
        seeds=[0],
        jobs=1,
    )
    config.validate()
    dataset = LeRobotDataset("local/odd", root=root)
    runs = SeedRuns(config, [0], dataset.meta)
    frames = _prepared_frames(runs, dataset)
    batch = runs.preprocessor(batch_of(root, range(len(numbers))))
    for key in (STATE, EXTRA, ACTION, "episode_index"):
        assert torch.equal(frames[key], batch[key]), key


def test_statistics_are_saved_as_they_are_and_actions_come_back(odd, tmp_path):
    """A checkpoint's processors, loaded again: not rounded to the data's type, each other's inverse."""
    root, numbers = odd
    policy, meta = make(root, backbone=MLPConfig(8, 1))
    folder = save_checkpoint(policy, meta, tmp_path / "checkpoint")
    preprocessor, postprocessor = make_pre_post_processors(policy.config, str(folder))
    batch = preprocessor(batch_of(root, range(5)))
    np.testing.assert_allclose(postprocessor(batch[ACTION]), numbers[:5], rtol=1e-3, atol=1e-3)
    preprocessor.save_pretrained(tmp_path / "again")  # as after training
    saved = load_file(next((tmp_path / "again").glob("*normalizer*.safetensors")))
    for statistic in ("mean", "std"):
        assert saved[f"{EXTRA}.{statistic}"].dtype == torch.float32
        np.testing.assert_allclose(saved[f"{EXTRA}.{statistic}"], meta.stats[EXTRA][statistic], rtol=1e-6)


def test_both_trainers_learn_the_same_from_odd_data(tmp_path, lerobot_train_command, swr_train):
    """A scalar action of whole numbers, a scalar, truth values and a grid: equal weights, a falling loss."""

    def frame(i, t, n):
        x, y = arc(i, t, n)
        return {
            STATE: np.array([x], np.float32),
            "observation.contact": np.array([t > n / 2, i % 2], bool),
            "observation.grid": np.outer([1, t], [y, 1, i]).astype(np.float32),
            "observation.count": np.array([t], np.uint8),
            ACTION: np.array([100 * y], np.int64),
        }

    features = {
        STATE: feature(1),
        "observation.contact": feature(2, dtype="bool"),
        "observation.grid": feature(2, 3),
        "observation.count": feature(1, dtype="uint8"),
        ACTION: feature(1, dtype="int64"),
    }
    root = write(tmp_path / "data", features, frame)
    options = (*SMALL, "--policy.optimizer_lr=0.005")
    lerobot_train_command(*train_flags("zbc", root, tmp_path / "one", 100, "--seed=0", *options))
    swr_train(*train_flags("zbc", root, tmp_path / "other", 100, "--seeds=0", "--jobs=1", *options))
    at = "checkpoints/000100/pretrained_model"
    one, other = tmp_path / "one" / at, tmp_path / "other/seed_0" / at
    weights = [load_file(folder / "model.safetensors") for folder in (one, other)]
    for key, value in weights[0].items():
        torch.testing.assert_close(value, weights[1][key], rtol=1e-2, atol=1e-3, msg=key)
    policy, _ = make(root, backbone=MLPConfig(16, 2))
    preprocessor, _ = make_pre_post_processors(policy.config, str(one))
    batch = preprocessor(batch_of(root, range(36)))
    before = policy.forward(batch)[0]
    policy.load_state_dict(weights[0])
    assert policy.forward(batch)[0] < before / 4


@pytest.mark.parametrize("policy_type", ["ddpm_gpt", "ddpm_act", "beso"])
def test_windows_of_scalars_keep_their_steps(policy_type, tmp_path):
    """A feature of shape (1,) in windows is (B, T, 1) in training, (B, 1) from an environment."""
    features = {STATE: feature(1), ACTION: feature(1, dtype="int64")}
    root = write(
        tmp_path / "data", features, lambda i, t, n: {STATE: arc(i, t, n)[:1], ACTION: np.array([t + i])}
    )
    policy, meta = make(root, policy_type, dim_model=16, n_heads=2, n_obs_steps=3)
    config = policy.config
    seconds = {
        key: [step / 10 for step in steps]
        for key, steps in ((STATE, config.observation_delta_indices), (ACTION, config.action_delta_indices))
    }
    preprocessor, postprocessor = make_pre_post_processors(config, dataset_stats=meta.stats)
    batch = preprocessor(batch_of(root, [0, 3, 8, 9, 20], delta_timestamps=seconds))
    assert batch[STATE].shape == (5, 3, 1)
    assert batch[ACTION].shape == (5, len(config.action_delta_indices), 1)
    assert policy.forward(batch)[0].isfinite()
    action = postprocessor(policy.eval().select_action(preprocessor({STATE: torch.zeros(4, 1)})))
    assert action.shape == (4, 1)
    lowest = (0 - meta.stats[ACTION]["mean"]) / meta.stats[ACTION]["std"]
    np.testing.assert_allclose(policy.action_low, lowest, rtol=1e-4)


def test_observations_of_an_environment_in_double_precision_are_taken(plain_arcs):
    """They are cast, and a single frame gets the dimension of a batch; the normaliser stays in float32."""
    policy, meta = make(plain_arcs, backbone=MLPConfig(8, 1))
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    for frame in (torch.zeros(3, 2, dtype=torch.float64), torch.zeros(2, dtype=torch.float64)):
        batch = preprocessor({STATE: frame})
        assert batch[STATE].shape == (frame.numel() // 2, 2)
        assert batch[STATE].dtype == torch.float32


def test_a_batch_that_was_not_prepared_is_refused_by_the_loss(plain_arcs):
    """(B, A) minus (B,) would be broadcast to (B, B), and a plausible loss would teach nothing."""
    policy, _ = make(plain_arcs, backbone=MLPConfig(8, 1))
    batch = {STATE: torch.zeros(2, 2), "episode_index": torch.tensor([0, 1]), ACTION: torch.zeros(2)}
    with pytest.raises(ValueError, match=r"actions have shape \[2\], those predicted \[2, 2\]"):
        policy.forward(batch)


def test_an_observation_of_another_shape_is_named():
    """By the first step of the preprocessor: feature, shape, and what was expected."""
    step = FloatVectorsProcessorStep({STATE: 2})
    with pytest.raises(ValueError, match=r"'observation.state' arrives with shape \[4, 3\].*\(batch, 2\)"):
        step({"observation": {STATE: torch.zeros(4, 3)}})
    with pytest.raises(
        ValueError, match=r"looks at observation.state, .* among the observations observation.q"
    ):
        step({"observation": {"observation.q": torch.zeros(4, 2)}})


def test_what_no_network_can_use_is_left_out(tmp_path, caplog):
    """Text, and observations under other names than LeRobot hands over, with a warning."""
    features = {
        **PLAIN,
        "observation.note": feature(1, dtype="string"),
        "observations.qpos": feature(2),
        "action.raw": feature(1),
    }

    def frame(i, t, n):
        extra = {"observation.note": "x", "observations.qpos": arc(i, t, n), "action.raw": arc(i, t, n)[:1]}
        return {**arcs(i, t, n), **extra}

    root = write(tmp_path / "data", features, frame)
    policy, meta = make(root, backbone=MLPConfig(8, 1))
    assert list(policy.config.input_features) == [STATE]
    assert list(policy.config.output_features) == [ACTION]
    assert "left out: observation.note, observations.qpos" in caplog.text
    preprocessor, _ = make_pre_post_processors(policy.config, dataset_stats=meta.stats)
    assert policy.forward(preprocessor(batch_of(root, range(4))))[0].isfinite()


@pytest.mark.parametrize("episodes", [None, [3, 1]])
def test_frames_of_files_in_another_order_are_lerobots(copied_arcs, tmp_path, episodes):
    """Rows of ``lerobot-swr-train`` are LeRobot's, also where a later episode lies in an earlier file."""
    split_into_files(copied_arcs, [1, 0, 3])
    config = SeedsTrainConfig(
        dataset=DatasetConfig("local/odd", root=str(copied_arcs), episodes=episodes),
        policy=make_policy_config("bc", backbone=MLPConfig(8, 1), device="cpu", push_to_hub=False),
        output_dir=tmp_path / "run",
        seeds=[0],
        jobs=1,
    )
    config.validate()
    dataset = LeRobotDataset("local/odd", root=copied_arcs, episodes=episodes)
    runs = SeedRuns(config, [0], dataset.meta)
    frames = _prepared_frames(runs, dataset)
    batch = runs.preprocessor(lerobot_collate_fn([dataset[row] for row in range(len(dataset))]))
    for key in (STATE, ACTION, "episode_index"):
        assert torch.equal(frames[key], batch[key]), key


def test_frames_in_memory_are_lerobots_with_text_and_any_index(copied_arcs, tmp_path):
    """Items of other policies' training, with a column of text and an index that restarts."""
    root = write(
        tmp_path / "data",
        {**PLAIN, "note": feature(1, dtype="string")},
        lambda i, t, n: {**arcs(i, t, n), "note": f"{i} {t}"},
    )
    set_column(root, "index", np.r_[np.arange(14), np.arange(22)], pa.int64())
    dataset = LeRobotDataset("local/odd", root=root)
    for item, expected in zip(
        MemoryDataset(dataset).__getitems__([3, 20]), (dataset[3], dataset[20]), strict=True
    ):
        assert item.keys() == expected.keys()
        for key, value in expected.items():
            assert torch.equal(item[key], value) if isinstance(value, torch.Tensor) else item[key] == value
