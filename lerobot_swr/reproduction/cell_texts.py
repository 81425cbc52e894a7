"""What a cell of the results says in a cell of a table, and captions that several tables share."""

from lerobot_swr.reproduction import paper
from lerobot_swr.reproduction.stored_results import StoredCell
from lerobot_swr.reproduction.suites import ONE_SCENE, UNPERTURBED
from lerobot_swr.reproduction.summary import Rate, Summary

NOTHING = "–"

INTERVALS = (
    "L1: mean over seeds [95 % bootstrap interval over seeds and rollouts; stratified: over seeds]. Floor: "
    "what perfect reproducers "
    "would score as the mean over as many seeds [central 95 %]; * L1 uniform lies outside of it. "
    "Success and style fidelity: over all rollouts [Wilson 95 %], lowest to highest seed in parentheses."
)


SCENES = (
    f"{ONE_SCENE}: all rollouts of a training seed start with box and target in one place, another one for "
    "each seed; otherwise every rollout has places of its own. A policy without styles or noise then repeats "
    "one rollout, and its interval of success says nothing. The paper does not say which it does; its BC, "
    "which succeeds in all rollouts of one seed and in almost none of the others, fits one scene."
)


def quoted(figures: paper.Quoted | None) -> str:
    """The paper's L1 and success, or a dash."""
    if figures is None:
        return NOTHING
    return f"{deviating(figures.l1)},\n{deviating(figures.success)}"


def deviating(figure: paper.Deviating) -> str:
    """Mean and standard deviation over training seeds."""
    return f"{figure[0]:.3f} ± {figure[1]:.3f}"


def share(rate: Rate | None) -> str:
    """A share with its interval and the range over seeds."""
    if rate is None:
        return NOTHING
    seeds = f"({min(rate.by_seed):.2f} to {max(rate.by_seed):.2f})"
    return f"{rate.mean:.3f}\n{rate.interval:.3f}\n{seeds}"


def l1(summary: Summary | None) -> str:
    """L1 with its interval; a star if styles were drawn uniformly and it lies outside the floor's band."""
    if summary is None:
        return NOTHING
    inside = summary.floor.band.low <= summary.l1 <= summary.floor.band.high
    star = "" if inside or summary.protocol != "uniform" else " *"
    return f"{summary.l1:.3f}{star}\n{summary.l1_interval:.3f}"


def floor(summary: Summary | None) -> str:
    """The floor with its band."""
    return NOTHING if summary is None else f"{summary.floor.mean:.3f}\n{summary.floor.band:.3f}"


def steps(cell: StoredCell) -> str:
    """Training steps and batch size."""
    return NOTHING if cell.training is None else f"{cell.training['steps']:,} × {cell.training['batch_size']}"


def rollouts(summary: Summary) -> str:
    """Seeds and rollouts."""
    return f"{summary.n_seeds} × {summary.n_rollouts}"


def named(cell: StoredCell) -> str:
    """A policy's name, and the condition where it is not the usual one."""
    usual = cell.labels.condition == UNPERTURBED
    return cell.labels.policy if usual else f"{cell.labels.policy},\n{cell.labels.condition}"
