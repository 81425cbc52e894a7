"""Control of the episode length: do rollouts keep to a band of lengths, as the demonstrations in it do?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.envs import EnvConfig
from matplotlib.figure import Figure

from lerobot_swr.configuration import tells_bad_values
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.checkpoint import Checkpoint
from lerobot_swr.evaluation.checks.check import ROLLOUTS, Check, Finding, Subject
from lerobot_swr.evaluation.metrics import Histogram, Interval, histogram, l1_distance, l1_floor
from lerobot_swr.evaluation.plots import save_figure
from lerobot_swr.evaluation.rollouts import allowed_episodes, recorded_starts, run_rollouts
from lerobot_swr.trajectories import Trajectories

BIN_WIDTH = 5  # steps
TOLERANCE = 2  # steps beyond the band that still count as inside


@dataclass(frozen=True)
class LengthControlResult:
    """Lengths of rollouts beside those of the demonstrations in a band.

    Attributes:
        band: Shortest and longest length, in frames of the demonstrations.
        frames_after_end: Frames that demonstrations record after the environment would have ended them; added
            to the rollouts' lengths so that both are counted alike.
        n_demonstrations: Number of demonstrations in the band.
        n_episodes: Number of rollouts.
        l1: L1 distance of the rollouts' length histogram to that of the demonstrations in the band, 0 to 2.
        l1_floor: L1 that a perfect reproducer of the demonstrations in the band would score on average,
            drawing with replacement.
        l1_floor_band: The central 95 % of that.
        in_band: Share of rollouts within the band, ± `TOLERANCE` steps.
        histogram: First length of a bin of `BIN_WIDTH` steps to share of the rollouts.
        reference_histogram: The same for the demonstrations in the band.
    """

    band: tuple[int, int]
    frames_after_end: int
    n_demonstrations: int
    n_episodes: int
    l1: float
    l1_floor: float
    l1_floor_band: Interval
    in_band: float
    histogram: Histogram
    reference_histogram: Histogram


def frames_after_end(trajectories: Trajectories, env_cfg: EnvConfig) -> int:
    """Median number of frames that demonstrations record after the environment would have ended them."""
    task = task_of(env_cfg)
    steps = [task.steps_to_end(episode) for episode in trajectories.episodes()]
    return int(np.median(trajectories.lengths - np.array(steps)))


def evaluate_length_control(
    rollout_lengths: Sequence[int],
    demonstration_lengths: Sequence[int],
    band: tuple[int, int],
    after_end: int = 0,
) -> LengthControlResult:
    """Compare lengths of rollouts with those of the demonstrations in a band.

    Args:
        rollout_lengths: Actions of each rollout.
        demonstration_lengths: Frames of every demonstration.
        band: Shortest and longest allowed length, in frames of the demonstrations.
        after_end: `frames_after_end`.

    Raises:
        ValueError: If no demonstration lies in the band.
    """
    low, high = band
    reference = [n for n in demonstration_lengths if low <= n <= high]
    if not reference:
        raise ValueError(
            f"check.band={[low, high]}: no demonstration has such a length; they have "
            f"{min(demonstration_lengths)} to {max(demonstration_lengths)} frames"
        )
    lengths = [n + after_end for n in rollout_lengths]
    expected, shown = (length_bins(part, low) for part in (reference, lengths))
    floor = l1_floor(expected, len(lengths))
    return LengthControlResult(
        band=(low, high),
        frames_after_end=after_end,
        n_demonstrations=len(reference),
        n_episodes=len(lengths),
        l1=l1_distance(histogram(shown), histogram(expected)),
        l1_floor=floor.mean,
        l1_floor_band=floor.band,
        in_band=float(np.mean([low - TOLERANCE <= n <= high + TOLERANCE for n in lengths])),
        histogram=dict(sorted(histogram(shown).items(), key=lambda item: int(item[0]))),
        reference_histogram=dict(sorted(histogram(expected).items(), key=lambda item: int(item[0]))),
    )


def length_bins(lengths: Sequence[int], low: int) -> list[str]:
    """First length of each length's bin; bins start at the band's lower end."""
    return [str(low + BIN_WIDTH * ((n - low) // BIN_WIDTH)) for n in lengths]


def format_length_control(result: LengthControlResult) -> str:
    """The figures, for the terminal."""
    floor = result.l1_floor_band
    return (
        f"lengths         L1 {result.l1:.3f} to the {result.n_demonstrations} demonstrations of "
        f"{result.band[0]} to {result.band[1]} frames (bins of {BIN_WIDTH}; perfect reproducer "
        f"{result.l1_floor:.3f} {floor:.3f})\n"
        f"                {result.in_band:.3f} of {result.n_episodes} rollouts in that band ± {TOLERANCE} "
        f"steps (counting {result.frames_after_end} frames that demonstrations record after the end)"
    )


def plot_length_control(path: Path, result: LengthControlResult, title: str) -> None:
    """Histograms of lengths: demonstrations in the band and rollouts.

    Args:
        path: Where to write the picture.
        result: The check.
        title: Heading.
    """
    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    bins = sorted({int(b) for b in (*result.histogram, *result.reference_histogram)})
    reference = [result.reference_histogram.get(str(b), 0.0) for b in bins]
    shown = [result.histogram.get(str(b), 0.0) for b in bins]
    place = np.array(bins) + BIN_WIDTH / 2
    axes.bar(
        place - 1, reference, 2, color="0.6", label=f"{result.n_demonstrations} demonstrations in the band"
    )
    axes.bar(place + 1, shown, 2, color="tab:blue", label=f"{result.n_episodes} rollouts")
    axes.axvspan(result.band[0], result.band[1] + 1, color="tab:green", alpha=0.12, linewidth=0, zorder=0)
    axes.set(xlabel="length in frames", ylabel="share of episodes")
    axes.set_xticks([*bins, bins[-1] + BIN_WIDTH], [*map(str, bins), str(bins[-1] + BIN_WIDTH)], rotation=90)
    axes.legend()
    axes.set_title(title, fontsize=10)
    save_figure(figure, path)


@Check.register_subclass("length")
@dataclass
class LengthCheck(Check):
    """Compare the rollouts' lengths with those of the demonstrations in a band."""

    # [shortest, longest] in frames of the demonstrations; null takes the band of those whose styles may be
    # drawn (for a policy without styles, of all).
    band: list[int] | None = None

    file = "length_control"
    heeds = ROLLOUTS
    needs_rule = False

    @tells_bad_values
    def __post_init__(self) -> None:
        """Check the band."""
        if self.band is not None and (len(self.band) != 2 or self.band[0] > self.band[1]):
            raise ValueError(f"check.band={self.band}: expected [shortest, longest], e.g. [70,80]")

    def run(self, subject: Subject, keep: Callable[[Any], None]) -> Finding:
        """Roll out and compare lengths."""
        checkpoint, env, options = subject.actor, subject.env, subject.rollouts
        assert checkpoint is not None
        assert env is not None
        band = self.band_of(checkpoint, subject.trajectories)
        starts = recorded_starts(env, subject.trajectories, options)
        rollouts = run_rollouts(
            checkpoint, env, lambda _: "", options.n_episodes, options.batch_size, options.seed, starts=starts
        )
        result = evaluate_length_control(
            [rollout.length for rollout in rollouts],
            subject.trajectories.lengths.tolist(),
            band,
            frames_after_end(subject.trajectories, env),
        )
        heading = f"{subject.title}: L1 {result.l1:.3f}"
        return Finding(
            result,
            format_length_control(result),
            lambda path: plot_length_control(path, result, heading),
        )

    def band_of(self, checkpoint: Checkpoint, trajectories: Trajectories) -> tuple[int, int]:
        """The band that is asked for, or that of the demonstrations whose styles may be drawn."""
        if self.band is not None:
            return self.band[0], self.band[1]
        drawn = allowed_episodes(checkpoint, len(trajectories))
        lengths = trajectories.lengths if drawn is None else trajectories.lengths[drawn]
        return int(lengths.min()), int(lengths.max())
