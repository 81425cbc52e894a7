"""Numbers of the paper that stand beside ours (arXiv 2504.18160v1).

Quoted are the figures that were at hand when this package was planned; the others are shown as "–". Its
mazes, demonstrations and magnitudes of perturbation are others than ours, so the figures tell the order of
magnitude and nothing more.
"""

SOURCE = "Petitbois, Portelas, Lamprier, Denoyer: arXiv 2504.18160v1"

# Table 1: (dataset, policy) -> L1 of the behaviour histograms, styles drawn uniformly.
TABLE1_L1: dict[tuple[str, str], float] = {
    ("medium_maze-one_side", "beso"): 0.140,
    ("medium_maze-one_side", "ddpm_act"): 0.640,
    ("medium_maze-one_side", "ddpm_gpt"): 0.100,
    ("medium_maze-only_forward", "beso"): 0.744,
    ("medium_maze-only_forward", "ddpm_act"): 0.916,
    ("medium_maze-only_forward", "ddpm_gpt"): 0.604,
}

# Table 2: success of WZBC on only_forward under its three perturbed conditions. Which figure belongs to which
# condition is not known to us, so tables quote them together.
ROBUSTNESS_WZBC_SUCCESS = (0.684, 0.978, 0.744)
