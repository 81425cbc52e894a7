"""The card of a policy: what it can do, how it was measured, how it is steered, where it is from."""

import json
import logging
import shlex
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_hub import HfApi, ModelCard, ModelCardData

from lerobot_swr.html_pages import principal_components
from lerobot_swr.installation import installed_versions
from lerobot_swr.sharing.folders import CARD, TAG
from lerobot_swr.sharing.markdown import code, escaped, table
from lerobot_swr.sharing.measures import ResultFile
from lerobot_swr.sharing.pictures import draw_groups
from lerobot_swr.styles.filters import describe_column
from lerobot_swr.styles.table import StyleTable
from lerobot_swr.whole_files import write_whole

PICTURE = "styles.png"
INSTALL = "pip install lerobot_policy_swr"
MAX_BEHAVIORS = 30
TRAINING_KEYS = ("steps", "batch_size", "seed")
SUMMARIES = {
    "bc": "Behaviour cloning without styles, the baseline of",
    "zbc": "A policy with one trained style per demonstration, of",
    "wzbc": "A policy with one style per demonstration, trained with similarity weighted regression, of",
}

logger = logging.getLogger(__name__)


def policy_card(
    policy: Any,
    dataset: str | None = None,
    repo_id: str | None = None,
    results: Sequence[ResultFile] = (),
    training: dict[str, Any] | None = None,
    pictures: Sequence[str] = (),
) -> ModelCard:
    """Make the card.

    Args:
        policy: A LeRobot policy.
        dataset: Name of its training dataset; None takes what the policy knows.
        repo_id: Its name on the Hub; None takes its configuration's.
        results: What evaluations found.
        training: The content of ``train_config.json``.
        pictures: Names of further pictures beside the card.
    """
    config = policy.config
    name = repo_id or config.repo_id or "PATH_OR_REPO"
    dataset = dataset or _dataset_name(policy)
    tags = sorted({"robotics", "lerobot", TAG, config.type, *(config.tags or ())})
    data = ModelCardData(
        license=config.license or "apache-2.0",
        library_name="lerobot",
        pipeline_tag="robotics",
        tags=tags,
        model_name=config.type,
        # The Hub takes names of its own repositories alone.
        datasets=dataset if dataset and not dataset.startswith("local/") else None,
    )
    summary = SUMMARIES.get(config.type, f"A `{config.type}` policy for")
    lines = [
        f"# {escaped(name.rpartition('/')[2] if name != 'PATH_OR_REPO' else config.type)}",
        "",
        f"{summary} `lerobot_policy_swr`, a plugin of [LeRobot](https://github.com/huggingface/lerobot). "
        "The method: [arXiv 2504.18160](https://arxiv.org/abs/2504.18160).",
        "",
        "## Install",
        "",
        *code(INSTALL),
    ]
    lines += _behaviors(policy)
    lines += _evaluations(results, pictures)
    lines += _use(policy, name)
    lines += _provenance(policy, dataset, training)
    return ModelCard(f"---\n{data.to_yaml()}\n---\n\n" + "\n".join(lines) + "\n")


def write_policy_card(policy: Any, folder: Path) -> None:
    """Write the card of a policy that has just been saved, and the picture of its styles, beside it.

    No training ends because a card cannot be made: that is logged.
    """
    try:
        picture = styles_picture(policy)
        if picture is not None:
            write_whole(folder / PICTURE, picture)
        write_whole(folder / CARD, policy_card(policy).content)
    except Exception as error:
        logger.warning("The card of %s was not written: %r", folder, error)


def upload_beside(policy: Any) -> None:
    """Put table and picture of the styles, which LeRobot's upload leaves out, beside a checkpoint."""
    table_of_styles = _table(policy)
    if table_of_styles is None:
        return
    repo_id, private = str(policy.config.repo_id), policy.config.private
    table_of_styles.upload(repo_id, private)
    picture = styles_picture(policy)
    if picture is not None:
        HfApi().upload_file(path_or_fileobj=picture, path_in_repo=PICTURE, repo_id=repo_id)


def styles_picture(policy: Any) -> bytes | None:
    """The trained styles along their main directions (PNG); None for a policy without."""
    known = _table(policy)
    episodes = _trained(policy)
    if known is None or not episodes:
        return None
    styles = policy.styles.embedding.weight.detach().cpu().numpy()[episodes]
    name = "behavior" if "behavior" in known.columns else "length"
    values = [known.columns[name][episode] for episode in episodes]
    points = list(principal_components(styles)[:, None])
    return draw_groups(points, values, name, "styles, along their two main directions")


def _table(policy: Any) -> StyleTable | None:
    return getattr(getattr(policy, "styles", None), "table", None)


def _trained(policy: Any) -> list[int]:
    styles = getattr(policy, "styles", None)
    return [] if styles is None else np.flatnonzero(styles.trained.cpu().numpy()).tolist()


def _dataset_name(policy: Any) -> str | None:
    trajectories = getattr(getattr(policy, "data", None), "trajectories", None)
    return None if trajectories is None else f"local/{Path(trajectories.name).name}"


def _behaviors(policy: Any) -> list[str]:
    """What the policy can do: its styles' behaviours with shares, or their columns' ranges."""
    known, episodes = _table(policy), _trained(policy)
    if known is None:
        return []
    lines = ["", "## What it can do", "", f"{len(episodes)} styles of {len(known)} demonstrations.", ""]
    if episodes:
        lines += [f"![The styles]({PICTURE})", ""]
    columns = (
        {name: [values[i] for i in episodes] for name, values in known.columns.items()} if episodes else {}
    )
    if "behavior" in columns:
        counted = Counter(map(str, columns["behavior"])).most_common()
        rows = [(label or "(none)", n, f"{n / len(episodes):.1%}") for label, n in counted[:MAX_BEHAVIORS]]
        if len(counted) > MAX_BEHAVIORS:
            rest = sum(n for _, n in counted[MAX_BEHAVIORS:])
            rows.append((f"{len(counted) - MAX_BEHAVIORS} others", rest, f"{rest / len(episodes):.1%}"))
        lines += [*table(("behaviour", "demonstrations", "share"), rows), ""]
    shown = [
        (name, describe_column(values))
        for name, values in columns.items()
        if name not in ("behavior", "episode") and not name.startswith(("first_", "last_"))
    ]
    lines += table(("of a demonstration", "values"), shown) if shown else []
    if known.filters:
        lines += ["", "Named filters, which a rollout's task string selects:", ""]
        lines += table(("task", "filter"), list(known.filters.items()))
    return lines


def _evaluations(results: Sequence[ResultFile], pictures: Sequence[str]) -> list[str]:
    if not results:
        return []
    lines = ["", "## Evaluation", "", "With 95 % intervals."]
    for result in results:
        lines += ["", f"`{result.path.name}`" + (f", {result.rollouts} rollouts" if result.rollouts else "")]
        lines += ["", *table(("measure", "value"), [(one.name, one) for one in result.measures])]
        if result.command:
            lines += ["", *code(result.command)]
    for picture in pictures:
        lines += ["", f"![{picture.removesuffix('.png')}]({picture})"]
    return lines


def _use(policy: Any, name: str) -> list[str]:
    rollout = f"lerobot-rollout --strategy.type=base --policy.path={name} --robot.type=..."
    lines = ["", "## Use", "", *code(rollout)]
    known, episodes = _table(policy), _trained(policy)
    if known is None or not episodes:
        return lines
    lines += ["", "Steer it; nothing is trained again, and the flags go with `lerobot-eval`, too:", ""]
    flags = []
    behaviors = [known.columns["behavior"][i] for i in episodes] if "behavior" in known.columns else []
    if behaviors:
        label = Counter(behaviors).most_common(1)[0][0]
        flags.append(
            (f"--policy.style_filter={shlex.quote(f'behavior == {json.dumps(label)}')}", "this behaviour")
        )
    lengths = np.array([known.columns["length"][i] for i in episodes], dtype=float)
    flags += [
        (f"--policy.style_filter='length <= {np.median(lengths):g}'", "the shorter demonstrations' styles"),
        (
            f"--policy.style_like={episodes[0]} --policy.style_neighbours=5",
            "a style and those nearest to it",
        ),
        ("--policy.style_sampling=stratified", "every style once before any again"),
    ]
    lines += code(*(f"{flag}  # {meaning}" for flag, meaning in flags))
    lines += ["", f"Filters know: {', '.join(f'`{key}`' for key in known.columns)}."]
    return lines


def _provenance(policy: Any, dataset: str | None, training: dict[str, Any] | None) -> list[str]:
    config = policy.config
    rows: list[tuple[str, object]] = [("policy", config.type)]
    backbone = getattr(config, "backbone", None)
    if backbone is not None:
        rows.append(("backbone", backbone.type))
    rows.append(("inputs", ", ".join(config.input_features or {})))
    rows.append(("outputs", ", ".join(config.output_features or {})))
    if dataset:
        rows.append(("dataset", dataset))
    fingerprint = getattr(config, "dataset_fingerprint", None)
    if fingerprint:
        rows.append(("fingerprint of its states", fingerprint))
    for key in TRAINING_KEYS:
        if training and training.get(key) is not None:
            rows.append((key.replace("_", " "), training[key]))
    rows += list(installed_versions().items())
    return ["", "## Provenance", "", *table(("", ""), rows)]
