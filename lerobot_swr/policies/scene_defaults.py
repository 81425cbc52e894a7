"""Options that fit how much the scenes of a dataset vary: chosen where left open, else recommended."""

import logging

from lerobot_swr.policies.configuration_swr import WZBCConfig, ZBCConfig
from lerobot_swr.scene_variation import SceneVariation

logger = logging.getLogger(__name__)


def fitting_options(config: ZBCConfig, scenes_vary: bool) -> dict[str, object]:
    """What suits a dataset, see the table in docs/scenes.md.

    Args:
        config: The policy's configuration.
        scenes_vary: Whether demonstrations begin in different scenes.
    """
    embedded = config.style_init == "similarity"
    options: dict[str, object] = {"style_sampling": "scene" if scenes_vary else "uniform"}
    # Where a style has few dimensions, it cannot hold the scene beside the manner.
    few = 4 if embedded else 10 if isinstance(config, WZBCConfig) else 2
    options["style_dim"] = few if scenes_vary else 10
    if isinstance(config, WZBCConfig):
        # What sees the manner tells partners from others, so these may be chosen narrowly; over raw states a
        # low beta only mixes manners.
        sees_manner = config.similarity_frame is not None or config.similarity_features is not None
        options["beta"] = 20.0 if scenes_vary and sees_manner else 10.0
    return options


def adopt_scene_defaults(config: ZBCConfig, variation: SceneVariation) -> None:
    """Say in a sentence how much scenes vary; choose the options that are null, recommend others.

    Args:
        config: The policy's configuration, changed in place.
        variation: Of the training dataset.
    """
    fitting = fitting_options(config, variation.vary)
    chosen = {key: value for key, value in fitting.items() if getattr(config, key) is None}
    for key, value in chosen.items():
        setattr(config, key, value)
    others = {key: value for key, value in fitting.items() if getattr(config, key) != value}
    words = [variation.describe()]
    if chosen:
        words.append(f"Chosen: {_flags(chosen)}.")
    if variation.vary and others:
        words.append(f"Recommended: {_flags(others)}.")
    if variation.vary and config.style_init == "normal":
        words.append("Styles that start from a similarity of manner do better still: docs/scenes.md.")
    logger.info(" ".join(words))


def _flags(options: dict[str, object]) -> str:
    return " ".join(f"--policy.{key}={value}" for key, value in options.items())
