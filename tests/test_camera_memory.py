"""Camera data train through LeRobot's own loader: nothing of ours holds frames."""

import gc
import types

import numpy as np
import pytest
import torch
from conftest import train_flags
from lerobot.datasets import LeRobotDataset
from lerobot.scripts import lerobot_train

EPISODES, FRAMES, SIDE = 4, 12, 192
FRAME_BYTES = SIDE * SIDE * 3  # of one picture, as it is recorded


@pytest.fixture(scope="module")
def camera_dataset(tmp_path_factory):
    """A dataset of four episodes with a camera; a picture is ten thousand times larger than a state."""
    root = tmp_path_factory.mktemp("camera") / "data"
    numbers = {"dtype": "float32", "shape": (2,), "names": ["x", "y"]}
    picture = {"dtype": "image", "shape": (SIDE, SIDE, 3), "names": ["height", "width", "channels"]}
    features = {"observation.state": numbers, "action": numbers, "observation.images.top": picture}
    dataset = LeRobotDataset.create("local/data", fps=10, root=root, features=features, use_videos=False)
    random = np.random.default_rng(0)
    for _ in range(EPISODES):
        for _ in range(FRAMES):
            dataset.add_frame(
                {
                    "observation.state": random.normal(size=2).astype("float32"),
                    "action": random.normal(size=2).astype("float32"),
                    "observation.images.top": random.integers(0, 255, (SIDE, SIDE, 3), dtype=np.uint8),
                    "task": "look",
                }
            )
        dataset.save_episode()
    dataset.finalize()
    return root


def held_bytes(root: object) -> int:
    """Bytes of all arrays and tensors that can be reached from an object, parameters of networks left out."""
    waiting, seen, total = [root], set(), 0
    while waiting:
        one = waiting.pop()
        if id(one) in seen or isinstance(one, types.ModuleType | type):
            continue
        seen.add(id(one))
        if isinstance(one, torch.nn.Parameter):
            continue
        if isinstance(one, torch.Tensor):
            total += one.untyped_storage().nbytes()
        elif isinstance(one, np.ndarray):
            total += one.nbytes if one.base is None else 0
            waiting.append(one.base)
        elif isinstance(one, types.FunctionType):  # not its module's globals
            waiting += [one.__closure__, one.__defaults__]
        else:
            waiting += gc.get_referents(one)
    return total


def test_arrays_are_counted_wherever_they_are():
    """The count itself: in attributes, lists, closures, and views."""
    numbers = np.zeros(1000, dtype=np.uint8)

    class Holder:
        pass

    holder = Holder()
    holder.listed = [torch.zeros(500, dtype=torch.uint8)]
    holder.closure = lambda: numbers
    holder.view = numbers[:10]
    assert held_bytes(holder) == 1500


def test_training_on_camera_data_holds_no_frames(
    camera_dataset, tmp_path, lerobot_train_command, monkeypatch
):
    """After ten steps over all frames, what the policy holds is smaller than two pictures of the 48."""
    made = []
    make = lerobot_train.make_policy

    def make_policy(*args, **kwargs):
        made.append(make(*args, **kwargs))
        return made[-1]

    monkeypatch.setattr(lerobot_train, "make_policy", make_policy)
    flags = train_flags("wzbc", camera_dataset, tmp_path / "run", 10, "--policy.backbone.hidden_dim=16")
    lerobot_train_command(*flags)
    [policy] = made
    assert held_bytes(policy) < 2 * FRAME_BYTES < EPISODES * FRAMES * FRAME_BYTES
