"""Which flags of ``lerobot-swr-eval`` have no effect beside others, or without an environment."""

from collections.abc import Collection

# Flags beside which others have no effect.
CONFLICTS = {
    "robustness": ("counterfactual", "blend", "length_band"),
    "counterfactual": (
        "length_band",
        "n_episodes",
        "style_sampling",
        "policy.style_sampling",
        "dataset.episodes",
    ),
    "blend": ("length_band", "n_episodes", "style_sampling", "policy.style_sampling", "dataset.episodes"),
    "length_band": ("dataset.episodes",),
    "recorded_starts": ("robustness", "counterfactual", "blend"),
    "scenes": ("recorded_starts", "robustness", "counterfactual", "blend", "policy.style_interpolate"),
    "style_sampling": ("policy.style_sampling",),
    "baseline": ("rename_map", "policy.*"),
    "baseline=replay": (
        "robustness",
        "counterfactual",
        "blend",
        "length_band",
        "n_episodes",
        "style_sampling",
        "recorded_starts",
        "scenes",
    ),
}
NEEDS_ENV = (
    *("robustness", "counterfactual", "blend", "length_band"),
    *("style_sampling", "n_episodes", "batch_size", "recorded_starts", "scenes"),
    *("policy.style_sampling", "policy.style_interpolate"),
)


def refuse_conflicts(given: Collection[str], has_env: bool) -> None:
    """Refuse flags that would have no effect.

    Args:
        given: Names of the flags that are given.
        has_env: Whether an environment is.

    Raises:
        ValueError: Naming both flags, or those that need an environment.
    """
    for first, others in CONFLICTS.items():
        for second in others:
            if first in given and second in given:
                raise ValueError(f"--{first} and --{second} exclude each other: leave out one of them")
    useless = [f"--{key}" for key in NEEDS_ENV if key in given]
    if useless and not has_env:
        raise ValueError(
            f"{', '.join(useless)}: this is about rollouts in an environment; name one with --env.type=... "
            "or leave it out to evaluate on the dataset's frames"
        )
