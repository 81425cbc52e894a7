"""``lerobot-swr-share``: a folder with a card, to give to others, of a checkpoint or a dataset; offline.

Examples:
    lerobot-swr-share CHECKPOINT --results=outputs/swr_eval/zbc --repo_id=me/my_policy
    lerobot-swr-share --dataset.root=data/mine --repo_id=me/my_demonstrations
"""

import itertools
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.behavior_rules import dataset_behavior_rule
from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.configuration import check_checkpoint_path
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_checkpoint, load_demonstrations
from lerobot_swr.sharing.dataset_card import PICTURE, dataset_card
from lerobot_swr.sharing.folders import CARD, copy_checkpoint, copy_dataset, copy_pictures, new_folder
from lerobot_swr.sharing.measures import find_results
from lerobot_swr.sharing.policy_card import PICTURE as STYLES_PICTURE
from lerobot_swr.sharing.policy_card import policy_card, styles_picture


@dataclass
class ShareCommand:
    """Options of ``lerobot-swr-share``."""

    # Folder of the checkpoint (pretrained_model); may be given as the first argument without a flag.
    checkpoint: Path | None = None
    # What lerobot-swr-eval wrote about it: files or folders. Their figures and pictures come into the card.
    results: list[Path] = field(default_factory=list)
    # Instead of a checkpoint: the dataset to share.
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Its rule for behaviours, module:function; null takes that of this package's datasets.
    behavior_rule: str | None = None
    # Name on the Hub, for the commands in the card; null takes the checkpoint's, or the folder's name.
    repo_id: str | None = None
    # Folder to write; null: outputs/share/<name>.
    output_dir: Path | None = None
    # The Hub's name of the license (apache-2.0, cc-by-4.0, ...); null: of a policy the checkpoint's, else
    # LeRobot's apache-2.0; of a dataset the card then says nothing of it.
    license: str | None = None
    # Replace a folder that this command wrote before.
    overwrite: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        given = self.dataset.root is not None or self.dataset.repo_id is not None
        if (self.checkpoint is not None) == given:
            raise ValueError(
                "checkpoint: name one thing to share, lerobot-swr-share CHECKPOINT or --dataset.root=FOLDER"
            )
        if given and self.results:
            raise ValueError(f"results={[str(one) for one in self.results]}: belong to a checkpoint's card")


@parser.wrap()
def share(cfg: ShareCommand) -> None:
    """Write the folder, and say how it is uploaded."""
    folder, repo_id, kind = _share_policy(cfg) if cfg.checkpoint is not None else _share_dataset(cfg)
    print(f"written to {folder}: look at {folder / CARD}")
    print(f"upload it: hf upload {repo_id} {folder} . --repo-type={kind}")


def _share_policy(cfg: ShareCommand) -> tuple[Path, str, str]:
    assert cfg.checkpoint is not None
    check_checkpoint_path(str(cfg.checkpoint))
    if not (cfg.checkpoint / "config.json").is_file():
        raise FileNotFoundError(
            f"checkpoint={str(cfg.checkpoint)!r}: no config.json there; give a checkpoint's pretrained_model "
            "folder"
        )
    results = find_results(cfg.results)
    config = PreTrainedConfig.from_pretrained(cfg.checkpoint)
    config.pretrained_path = cfg.checkpoint
    policy = load_checkpoint(config).policy
    policy.config.license = cfg.license or policy.config.license
    file = cfg.checkpoint / "train_config.json"
    training = json.loads(file.read_text()) if file.is_file() else {}
    dataset = (training.get("dataset") or {}).get("repo_id")
    repo_id = cfg.repo_id or config.repo_id or f"YOUR_NAME/{config.type}"
    folder = cfg.output_dir or Path("outputs/share") / repo_id.rpartition("/")[2]
    with new_folder(folder, cfg.overwrite) as new:
        copy_checkpoint(cfg.checkpoint, new)
        pictures = copy_pictures(cfg.results, new)
        styles = styles_picture(policy)
        if styles is not None:
            (new / STYLES_PICTURE).write_bytes(styles)
        card = policy_card(policy, dataset, repo_id, results, training, pictures)
        (new / CARD).write_text(card.content, encoding="utf-8")
    return folder, repo_id, "model"


def _share_dataset(cfg: ShareCommand) -> tuple[Path, str, str]:
    meta: LeRobotDatasetMetadata = cfg.dataset.metadata()
    repo_id = cfg.repo_id or cfg.dataset.repo_id or f"YOUR_NAME/{meta.root.name}"
    rule = dataset_behavior_rule(cfg.behavior_rule, meta.robot_type)
    folder = cfg.output_dir or Path("outputs/share") / repo_id.rpartition("/")[2]
    with new_folder(folder, cfg.overwrite) as new:
        copy_dataset(meta.root, new)
        card, picture = dataset_card(meta, load_demonstrations(meta), rule, repo_id, cfg.license)
        (new / PICTURE).write_bytes(picture)
        (new / CARD).write_text(card.content, encoding="utf-8")
    return folder, repo_id, "dataset"


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging(console_level="WARNING")
    register_third_party_plugins()
    words = list(itertools.takewhile(lambda word: not word.startswith("-"), sys.argv[1:]))
    if len(words) > 1:
        raise ValueError(f"checkpoint={' '.join(words)!r}: share one thing at a time")
    if words:
        sys.argv[1] = f"--checkpoint={words[0]}"
    sys.argv = list(with_literal_text([_as_list(one) for one in sys.argv], ("behavior_rule",)))
    share()


def _as_list(argument: str) -> str:
    """``--results=A,B`` or ``--results=A`` as a list of paths."""
    name, _, value = argument.partition("=")
    if name != "--results" or value.startswith("["):
        return argument
    return f"--results={json.dumps(value.split(','))}"


if __name__ == "__main__":
    main()
