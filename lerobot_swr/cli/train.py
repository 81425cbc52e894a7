"""``lerobot-swr-train``: ``lerobot-train`` for several seeds at once.

Examples:
    lerobot-swr-train --seeds=0,1,2,3,4 --policy.type=wzbc --policy.device=cpu --policy.push_to_hub=false \
        --dataset.repo_id=local/only_forward --dataset.root=data/only_forward \
        --batch_size=16 --steps=100000 --output_dir=outputs/train/wzbc
    # interrupted? The same command goes on with --resume=true
"""

import re
import sys
from collections.abc import Iterator

from lerobot.configs import parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.configuration import check_dataset_folder
from lerobot_swr.training import SeedsTrainConfig, train_seeds


@parser.wrap()
def train(cfg: SeedsTrainConfig) -> None:
    """Train, and print where the policies are."""
    cfg.validate()
    for folder in train_seeds(cfg):
        print(folder)


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging()
    register_third_party_plugins()
    if parser.parse_arg("seed") is not None:
        raise ValueError(
            f"seed={parser.parse_arg('seed')}: this command takes --seeds={parser.parse_arg('seed')}"
        )
    sys.argv = list(_with_brackets(sys.argv))
    check_dataset_folder()  # the parser would hide what it says
    train()


def _with_brackets(arguments: list[str]) -> Iterator[str]:
    """``--seeds=0,1,2`` or ``--seeds 0,1,2`` as ``--seeds=[0,1,2]``, which LeRobot's parser understands."""
    joined = re.sub(r"(^|\n)--seeds\n(?=\d)", r"\1--seeds=", "\n".join(arguments))
    for argument in joined.split("\n"):
        yield re.sub(r"^--seeds=(\d+(,\d+)*)$", r"--seeds=[\1]", argument)


if __name__ == "__main__":
    main()
