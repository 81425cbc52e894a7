"""Numbers of the paper that stand beside ours.

Its mazes, demonstrations and magnitudes of perturbation are others than ours, so the figures tell the order
of magnitude and nothing more. Means over its training seeds; DDPM-GPT and DDPM-ACT
are its names of ``ddpm_gpt`` and ``ddpm_act``. The figures are those of the authors' page of it,
https://github.com/mathieu-petitbois/mathieu-petitbois.github.io, projects/swr, commit 66dcc12.
"""

from typing import NamedTuple

SOURCE = "Petitbois, Portelas, Lamprier, Denoyer: arXiv 2504.18160"


class Quoted(NamedTuple):
    """L1 of the behaviour histograms, and the share of successes."""

    l1: float
    success: float


_POLICIES = ("bc", "zbc", "wzbc", "beso", "ddpm_act", "ddpm_gpt")
_L1 = {
    "medium_maze-only_forward": (1.74, 0.256, 0.248, 0.744, 0.916, 0.604),
    "medium_maze-one_side": (1.4, 0.044, 0.06, 0.140, 0.640, 0.100),
    "d3il_avoiding": (1.917, 0.265, 0.482, 0.901, 0.781, 0.531),
    "d3il_unbalanced_avoiding": (1.925, 0.102, 1.457, 1.283, 1.342, 1.26),
    "d3il_aligning": (1.0, 0.172, 0.552, 0.472, 0.488, 0.296),
    "d3il_unbalanced_aligning": (0.4, 0.172, 0.364, 0.256, 0.212, 0.288),
}
_SUCCESS = {
    "medium_maze-only_forward": (1.0, 1.0, 0.99, 0.998, 0.9, 1.0),
    "medium_maze-one_side": (0.6, 1.0, 1.0, 1.0, 0.994, 1.0),
    "d3il_avoiding": (1.0, 0.996, 0.954, 0.998, 0.904, 0.986),
    "d3il_unbalanced_avoiding": (0.6, 0.75, 0.802, 1.0, 0.996, 0.999),
    "d3il_aligning": (0.21, 0.52, 0.806, 0.910, 0.872, 0.852),
    "d3il_unbalanced_aligning": (1.0, 0.328, 0.762, 0.922, 0.882, 0.844),
}

TABLE1: dict[tuple[str, str], Quoted] = {
    (dataset, policy): Quoted(l1, success)
    for dataset in _L1
    for policy, l1, success in zip(_POLICIES, _L1[dataset], _SUCCESS[dataset], strict=True)
}
"""(dataset, policy)."""

TABLE2: dict[tuple[str, str, str], Quoted] = {
    ("medium_maze-only_forward", condition, policy): Quoted(l1, success)
    for condition, rows in {
        "deterministic": {"zbc": (0.256, 1.0), "wzbc": (0.248, 0.99)},
        "pseudo-random start": {"zbc": (1.152, 0.448), "wzbc": (0.828, 0.684)},
        "random start": {"zbc": (1.556, 0.858), "wzbc": (1.552, 0.978)},
        "transition noise": {"zbc": (0.729, 0.632), "wzbc": (0.744, 0.744)},
    }.items()
    for policy, (l1, success) in rows.items()
}
"""(dataset, condition, policy)."""
