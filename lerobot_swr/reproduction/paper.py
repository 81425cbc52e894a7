"""Numbers of the paper that stand beside ours.

Its mazes, demonstrations and magnitudes of perturbation are others than ours, so the figures tell the order
of magnitude and nothing more; only the 96 human recordings of avoiding are the same (the unbalanced selection
of them is ours). Means and standard deviations over its 5 training seeds, from the source of arXiv 2504.18160
(the authors' project page differs from it in five places). DDPM-GPT and DDPM-ACT are its names of
``ddpm_gpt`` and ``ddpm_act``.
"""

from typing import NamedTuple

SOURCE = "Petitbois, Portelas, Lamprier, Denoyer: arXiv 2504.18160"
POLICIES = ("bc", "zbc", "wzbc", "beso", "ddpm_act", "ddpm_gpt")

Deviating = tuple[float, float]
"""Mean and standard deviation over training seeds."""


class Quoted(NamedTuple):
    """L1 of the behaviour histograms, and the share of successes."""

    l1: Deviating
    success: Deviating


_L1: dict[str, tuple[Deviating, ...]] = {
    "medium_maze-only_forward": (
        *((1.74, 0.054), (0.256, 0.023), (0.248, 0.047)),
        *((0.744, 0.041), (0.916, 0.252), (0.604, 0.082)),
    ),
    "medium_maze-one_side": (
        *((1.4, 0.49), (0.044, 0.032), (0.06, 0.033)),
        *((0.140, 0.049), (0.640, 0.390), (0.100, 0.075)),
    ),
    "d3il_avoiding": (
        *((1.917, 0.0), (0.265, 0.0), (0.482, 0.026)),
        *((0.901, 0.091), (0.781, 0.184), (0.531, 0.093)),
    ),
    "d3il_unbalanced_avoiding": (
        *((1.925, 0.062), (1.02, 0.116), (1.457, 0.087)),
        *((1.283, 0.067), (1.342, 0.134), (1.26, 0.026)),
    ),
    "d3il_aligning": (
        *((1.0, 0.0), (0.172, 0.17), (0.552, 0.224)),
        *((0.472, 0.111), (0.488, 0.075), (0.296, 0.104)),
    ),
    "d3il_unbalanced_aligning": (
        *((0.4, 0.0), (0.172, 0.057), (0.364, 0.037)),
        *((0.256, 0.066), (0.212, 0.053), (0.288, 0.063)),
    ),
}
_SUCCESS: dict[str, tuple[Deviating, ...]] = {
    "medium_maze-only_forward": (
        *((1.0, 0.0), (1.0, 0.0), (0.99, 0.0)),
        *((0.998, 0.004), (0.9, 0.12), (1.0, 0.0)),
    ),
    "medium_maze-one_side": (
        *((0.6, 0.49), (1.0, 0.0), (1.0, 0.0)),
        *((1.0, 0.0), (0.994, 0.012), (1.0, 0.0)),
    ),
    "d3il_avoiding": (
        *((1.0, 0.0), (0.996, 0.005), (0.954, 0.024)),
        *((0.998, 0.004), (0.994, 0.008), (0.986, 0.006)),
    ),
    "d3il_unbalanced_avoiding": (
        *((0.6, 0.49), (0.75, 0.092), (0.802, 0.113)),
        *((1.0, 0.0), (0.99, 0.013), (0.996, 0.005)),
    ),
    "d3il_aligning": (
        *((0.21, 0.395), (0.552, 0.032), (0.806, 0.105)),
        *((0.908, 0.012), (0.872, 0.047), (0.852, 0.055)),
    ),
    "d3il_unbalanced_aligning": (
        *((1.0, 0.0), (0.328, 0.054), (0.762, 0.126)),
        *((0.922, 0.013), (0.882, 0.038), (0.844, 0.015)),
    ),
}
_SAME_TASK = {
    "d3il_human_avoiding": "d3il_avoiding",
    "d3il_human_unbalanced_avoiding": "d3il_unbalanced_avoiding",
}


def table1(dataset: str, policy: str) -> Quoted | None:
    """The paper's Table 1 for a dataset, one of human recordings included, and a policy's type."""
    row = _SAME_TASK.get(dataset, dataset)
    if row not in _L1 or policy not in POLICIES:
        return None
    column = POLICIES.index(policy)
    return Quoted(_L1[row][column], _SUCCESS[row][column])


TABLE2: dict[tuple[str, str, str], Quoted] = {
    ("medium_maze-only_forward", condition, policy): quoted
    for condition, rows in {
        "deterministic": {
            "zbc": Quoted((0.256, 0.023), (1.0, 0.0)),
            "wzbc": Quoted((0.248, 0.047), (0.99, 0.0)),
        },
        "pseudo-random start": {
            "zbc": Quoted((1.152, 0.094), (0.448, 0.031)),
            "wzbc": Quoted((0.828, 0.349), (0.684, 0.152)),
        },
        "random start": {
            "zbc": Quoted((1.556, 0.079), (0.858, 0.046)),
            "wzbc": Quoted((1.552, 0.037), (0.978, 0.019)),
        },
        "transition noise": {
            "zbc": Quoted((0.729, 0.134), (0.632, 0.066)),
            "wzbc": Quoted((0.744, 0.029), (0.744, 0.038)),
        },
    }.items()
    for policy, quoted in rows.items()
}
"""(dataset, condition, policy)."""
