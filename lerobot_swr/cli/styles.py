"""``lerobot-swr-styles CHECKPOINT``: see, name and map the styles of a policy, and add new demonstrations.

Examples:
    lerobot-swr-styles CHECKPOINT
    lerobot-swr-styles CHECKPOINT --filter="mean_speed < 0.3" --name=slowly
    lerobot-swr-styles CHECKPOINT --map=styles.html
    lerobot-swr-styles CHECKPOINT --add=data/new_demonstrations --output_dir=outputs/with_new

CHECKPOINT is the folder ``pretrained_model`` of a zbc or wzbc policy.
"""

import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from lerobot.configs import PreTrainedConfig, parser
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.dataset_checks import check_dimensions
from lerobot_swr.evaluation.checkpoint import Checkpoint, DatasetSource, load_checkpoint, load_reference
from lerobot_swr.policies.configuration_swr import ZBCConfig
from lerobot_swr.policies.demonstration_frames import demonstration_frames
from lerobot_swr.policies.style_policy import StylePolicy
from lerobot_swr.policies.training_data import read_demonstrations
from lerobot_swr.similarity import similarity_by
from lerobot_swr.styles.extension import add_demonstrations
from lerobot_swr.styles.map import write_style_map
from lerobot_swr.styles.report import format_preview, format_table
from lerobot_swr.styles.table import StyleTable, make_nearest_table
from lerobot_swr.trajectories import Trajectories

TEXT_FLAGS = ("filter", "name", "forget", "behavior_rule", "style_metrics")


@dataclass
class StylesCommand:
    """Options of ``lerobot-swr-styles``."""

    # Folder of the checkpoint (pretrained_model); may be given as the first argument without a flag.
    checkpoint: Path
    # Preview this filter: how many demonstrations, which, their histogram.
    filter: str | None = None
    # Save the filter in the checkpoint under this name; a rollout whose task is the name draws from it.
    name: str | None = None
    # Remove the named filter of this name from the checkpoint.
    forget: str | None = None
    # Rows of the table to print.
    rows: int = 10
    # Write the interactive map into this HTML file.
    map: Path | None = None
    # The training dataset, for the map and for --add; giving it makes the table anew. null takes the dataset
    # that the checkpoint's train_config.json names.
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Make the table anew with this rule for the column "behavior": module:function or behaviors.json.
    behavior_rule: str | None = None
    # Make the table anew with these further columns: module:function, or a .json or .csv file of values of
    # the episodes; several are separated by commas.
    style_metrics: str | None = None
    # Find styles for the demonstrations of the dataset in this folder and write a new checkpoint.
    add: Path | None = None
    # Only these episodes of that dataset; null takes all that have no style yet.
    episodes: list[int] | None = None
    # Folder of the new checkpoint.
    output_dir: Path | None = None

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
            FileNotFoundError: If there is no checkpoint.
            FileExistsError: If the new checkpoint's folder exists.
        """
        if not (self.checkpoint / "config.json").is_file():
            raise FileNotFoundError(
                f"checkpoint={str(self.checkpoint)!r}: no config.json there; give a checkpoint's "
                "pretrained_model folder (download it first, if it is on the Hub)"
            )
        if self.name is not None and self.filter is None:
            raise ValueError(f"name={self.name!r}: give the filter to save, --filter=...")
        if (self.add is None) != (self.output_dir is None):
            raise ValueError("add and output_dir belong together: --add=DATASET --output_dir=NEW_CHECKPOINT")
        if self.output_dir is not None and self.output_dir.exists():
            raise FileExistsError(
                f"output_dir={str(self.output_dir)!r} already exists; choose another folder"
            )


@parser.wrap()
def show_styles(cfg: StylesCommand) -> None:
    """Do what the options say."""
    config = PreTrainedConfig.from_pretrained(cfg.checkpoint)
    if not isinstance(config, ZBCConfig):
        raise ValueError(
            f"checkpoint={str(cfg.checkpoint)!r} is a {config.type!r} policy, which has no styles"
        )
    config.pretrained_path = cfg.checkpoint
    given = cfg.dataset.root is not None or cfg.dataset.repo_id is not None
    if not given:
        cfg.dataset = _training_dataset(cfg.checkpoint)
    if given or cfg.behavior_rule or cfg.style_metrics:
        _make_table_anew(cfg, config)
    checkpoint = load_checkpoint(config)
    policy = checkpoint.policy
    assert isinstance(policy, StylePolicy)
    if cfg.add is not None:
        _add(cfg, checkpoint, policy)
        return

    table = policy.styles.table
    if table is None:
        raise ValueError(
            f"checkpoint={str(cfg.checkpoint)!r} has no table of its demonstrations (an earlier version made "
            "it): make it with --dataset.root=TRAINING_DATASET"
        )
    if cfg.forget is not None:
        table = table.without_filter(cfg.forget)
        table.save(cfg.checkpoint)
    episodes = policy.styles.trained.nonzero().squeeze(1).tolist()
    if cfg.filter is None:
        print(format_table(table, episodes, cfg.rows, f"{config.type}, {cfg.checkpoint}"))
    else:
        print(format_preview(table, episodes, policy.styles.filter(cfg.filter), cfg.filter))
    if cfg.name is not None:
        table.with_filter(cfg.name, cfg.filter or "").save(cfg.checkpoint)
        print(f"saved as {cfg.name!r}: a rollout with --task={cfg.name!r} draws from these styles")
    if cfg.map is not None:
        _write_map(cfg, checkpoint, policy, table, episodes)


def _training_dataset(checkpoint: Path) -> DatasetSource:
    """The dataset that the checkpoint's training run used."""
    file = checkpoint / "train_config.json"
    dataset = json.loads(file.read_text()).get("dataset", {}) if file.is_file() else {}
    root = dataset.get("root")
    return DatasetSource(root=None if root is None else Path(root), repo_id=dataset.get("repo_id"))


def _make_table_anew(cfg: StylesCommand, config: ZBCConfig) -> None:
    """Write the table that the training dataset and the given rule and metrics make; keep named filters."""
    config.behavior_rule = cfg.behavior_rule or config.behavior_rule
    config.style_metrics = cfg.style_metrics or config.style_metrics
    if config.num_added_styles:
        raise ValueError(
            f"checkpoint={str(cfg.checkpoint)!r} has {config.num_added_styles} added styles, whose "
            "demonstrations are not in the training dataset: make the table of the original checkpoint anew, "
            "then add them"
        )
    checkpoint = load_checkpoint(config)
    load_reference(cfg.dataset, checkpoint)  # refuses another dataset
    # A policy made for training would take this for its training and describe the dynamics anew.
    policy, meta = checkpoint.policy, cfg.dataset.metadata()
    stored = policy.styles.table
    demonstrations = read_demonstrations(config, meta)
    similarity = similarity_by(demonstrations, config.manner, Path(meta.root))
    table = make_nearest_table(
        demonstrations, similarity, config.behavior_rule, config.style_metrics, meta.robot_type
    )
    for name, text in ({} if stored is None else stored.filters).items():
        table = table.with_filter(name, text)
    table.save(cfg.checkpoint)
    pretrained_path, config.pretrained_path = config.pretrained_path, None
    config.save_pretrained(cfg.checkpoint)
    config.pretrained_path = pretrained_path


def _write_map(
    cfg: StylesCommand,
    checkpoint: Checkpoint,
    policy: StylePolicy,
    table: StyleTable,
    episodes: Sequence[int],
) -> None:
    assert cfg.map is not None
    try:
        trajectories = _reference(cfg, checkpoint)
    except (ValueError, OSError) as error:
        print(f"without the demonstrations' paths, which need the training dataset ({error})")
        trajectories = None
    styles = policy.styles.embedding.weight.detach().cpu().numpy()[list(episodes)]
    title = f"{len(episodes)} styles of {policy.config.type}, {cfg.checkpoint}"
    write_style_map(cfg.map, styles, list(episodes), table, trajectories, title)
    print(f"map written to {cfg.map}")


def _add(cfg: StylesCommand, checkpoint: Checkpoint, policy: StylePolicy) -> None:
    assert cfg.add is not None
    assert cfg.output_dir is not None
    meta = DatasetSource(root=cfg.add, episodes=cfg.episodes).metadata()
    where, dimensions = f"add={str(cfg.add)!r}", policy.config.dimensions
    missing = [key for key in dimensions if key not in meta.features]
    if missing:
        raise ValueError(f"{where}: the dataset lacks {', '.join(missing)}, which the policy needs")
    shapes = {key: ft["shape"] for key, ft in meta.features.items()}
    check_dimensions(
        where, shapes, {key: [d] for key, d in dimensions.items()}, "add demonstrations of the same robot"
    )
    training = _reference(cfg, checkpoint, needs_actions=True)
    new = read_demonstrations(policy.config, meta)
    source = demonstration_frames(policy.config, meta, new, checkpoint.preprocessor)
    added = add_demonstrations(
        policy,
        checkpoint.preprocessor,
        training,
        new,
        cfg.episodes,
        meta.robot_type,
        read=lambda episode: source.frames(episode, np.arange(new.lengths[episode])),
    )
    _save_new_checkpoint(cfg.checkpoint, policy, cfg.output_dir)
    error = "action error" if policy.config.traits.is_momentary else "loss"
    print(f"style  nearest demonstration  {error} (under the nearest demonstration's style)")
    for row in zip(added.episodes, added.nearest, added.errors, added.errors_of_nearest, strict=True):
        print("{:5d}  {:21d}  {:.4f} ({:.4f})".format(*row))
    numbers = ",".join(map(str, added.episodes))
    print(f"written to {cfg.output_dir}; draw only these with --policy.style_episodes=[{numbers}]")


def _reference(cfg: StylesCommand, checkpoint: Checkpoint, needs_actions: bool = False) -> Trajectories:
    """The training dataset."""
    root = cfg.dataset.root
    if root is not None and not root.is_dir():
        raise FileNotFoundError(
            f"dataset.root={str(root)!r}, the training dataset of {cfg.checkpoint}, does not exist; was it "
            "moved? Give its folder: --dataset.root=FOLDER"
        )
    return load_reference(cfg.dataset, checkpoint, needs_actions)


def _save_new_checkpoint(original: Path, policy: StylePolicy, folder: Path) -> None:
    """The original's files (processors, training configuration) with the enlarged policy; all or nothing."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    unfinished = folder.with_name(f".{folder.name}-unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    shutil.copytree(original, unfinished)
    policy.config.pretrained_path = None
    policy.save_pretrained(unfinished)
    unfinished.rename(folder)


@explain_errors
def main() -> None:
    """Entry point; ``CHECKPOINT`` as the first argument means ``--checkpoint=CHECKPOINT``."""
    init_logging()
    register_third_party_plugins()
    if len(sys.argv) > 1 and not sys.argv[1].startswith("-"):
        sys.argv[1] = f"--checkpoint={sys.argv[1]}"
    sys.argv = list(with_literal_text(sys.argv, TEXT_FLAGS))
    show_styles()


if __name__ == "__main__":
    main()
