"""Demonstrations of people with a camera: PushT's 206, as LeRobot trains on them."""

import json
import os
from pathlib import Path

import pytest
from conftest import train_flags
from styled_policies import checkpoint, load, nested

REFERENCE = Path(os.environ.get("LEROBOT_SWR_REFERENCE", Path(__file__).parents[2] / "shared"))
PUSHT = REFERENCE / "human_demos" / "pusht_human"
SEEN = {
    "observation.state": {"type": "STATE", "shape": [2]},
    "observation.image": {"type": "VISUAL", "shape": [3, 96, 96]},
}


@pytest.mark.skipif(
    not (PUSHT / "meta" / "info.json").is_file(),
    reason=f"{PUSHT} is absent: point LEROBOT_SWR_REFERENCE at the folder that holds human_demos",
)
@pytest.mark.parametrize(("policy_type", "kind"), [("zbc", "act"), ("wzbc", "diffusion")])
def test_people_s_pushes_are_learned_through_their_camera(lerobot_train_command, tmp_path, policy_type, kind):
    """206 episodes with video: picture and agent in, the block's place left out; a style per episode."""
    flags = [*nested(kind), f"--policy.input_features={json.dumps(SEEN)}", "--log_freq=1"]
    video = ["--dataset.video_backend=pyav", "--dataset.episodes=[0,3,17]", "--batch_size=2"]
    lerobot_train_command(*train_flags(policy_type, PUSHT, tmp_path / "run", 2, *flags, *video))
    policy = load(checkpoint(tmp_path / "run"))
    assert set(policy.config.input_features) == set(SEEN)
    assert set(policy.backbone.policy.config.image_features) == {"observation.image"}
    assert policy.styles.trained.nonzero().flatten().tolist() == [0, 3, 17]
    assert policy.config.compared_keys == ["observation.state"]
