"""What a policy's styles are made of: its cookbook, where they start, who shares them, the table."""

import numpy as np

from lerobot_swr.policies.configuration_swr import BCConfig, WZBCConfig, ZBCConfig
from lerobot_swr.policies.lessons import Balance
from lerobot_swr.policies.training_data import TrainingData
from lerobot_swr.sampling import PartnerSampler, check_partner_sampling
from lerobot_swr.similarity import check_normalization
from lerobot_swr.styles.cookbook import StyleCookbook
from lerobot_swr.styles.drawing import check_style_sampling
from lerobot_swr.styles.embedding import MannerEmbedding
from lerobot_swr.styles.table import StyleTable, make_nearest_table


def make_balance(config: BCConfig, data: TrainingData) -> Balance:
    """Lets all episodes that are trained on count alike, as far as LeRobot's sampler shows them."""
    episodes, alike = data.run.episodes, config.balance_episodes
    return Balance(data.trajectories, episodes, data.pauses, alike, config.unseen_frames)


def make_cookbook(config: ZBCConfig, data: TrainingData | None) -> StyleCookbook:
    """One style per demonstration: of a training dataset, or to be loaded."""
    assert config.num_episodes is not None
    assert config.style_dim is not None
    styles = StyleCookbook(
        config.num_episodes + config.num_added_styles,
        config.style_dim,
        config.style_init_scale,
        check_style_sampling(config.style_sampling or "uniform"),
        config.style_selection,
        config.observation_dim,
        config.near_scenes,
    )
    if config.style_init == "similarity":
        styles.embed(make_embedding(config, data), None if data is None else data.compared)
    styles.embedding.requires_grad_(not config.has_fixed_styles)
    if data is not None:
        styles.trained[list(data.run.episodes)] = 1
        styles.scenes.fit(data.first_observations, data.scene_variation.shares > 0)
        styles.table = make_table(config, data)
    return styles


def make_sampler(config: WZBCConfig, data: TrainingData) -> PartnerSampler:
    """Draws partners among the episodes that are trained on.

    Raises:
        ValueError: If there is a single one.
    """
    if len(data.run.episodes) < 2:
        raise ValueError(
            f"dataset.root={str(data.root)!r}: a single episode to train on; wzbc compares "
            "episodes and needs at least 2: record more, leave more in, or use --policy.type=zbc"
        )
    assert config.beta is not None
    return PartnerSampler(
        data.similarity,
        np.array(data.run.episodes),
        config.beta,
        config.p,
        check_normalization(config.similarity_normalization),
        check_partner_sampling(config.partner_sampling),
    )


def make_embedding(config: ZBCConfig, data: TrainingData | None) -> MannerEmbedding:
    """What gives demonstrations their styles by what similarity compares: of the dataset, or to be loaded.

    Raises:
        ValueError: If the demonstrations that are trained on are all alike.
    """
    columns = config.manner.columns
    if data is not None:
        trained = np.array(data.run.episodes)
        width = data.compared.joined(columns).shape[1]
        config.embedded_shape = (int(data.compared.lengths[trained].max()), width)
    if config.embedded_shape is None:
        raise ValueError("style_init='similarity': this takes effect when a policy is created with a dataset")
    assert config.style_dim is not None
    embedding = MannerEmbedding(config.style_dim, *config.embedded_shape)
    if data is not None:
        embedding.fit(data.compared.joined(columns), data.compared.lengths, trained)
    return embedding


def make_table(config: ZBCConfig, data: TrainingData) -> StyleTable:
    """The table of the demonstrations, with the columns that the configuration asks for."""
    rule, metrics, robot = config.behavior_rule, config.style_metrics, data.meta.robot_type
    return make_nearest_table(data.trajectories, data.similarity, rule, metrics, robot)
