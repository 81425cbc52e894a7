"""Pre- and post-processing of ``toy``."""

from lerobot.processor import make_default_pre_post_processors


def make_toy_pre_post_processors(config, dataset_stats=None):
    """LeRobot's default."""
    return make_default_pre_post_processors(config, dataset_stats)
