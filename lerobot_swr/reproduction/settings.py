"""What a user chooses about the reproduction; the rest is fixed in the suites."""

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SUITES = ("table1", "robustness", "contracting", "control", "scenes", "figures")
MAX_ROLLOUTS = 100_000  # per training seed: how far apart the environments' seeds of training seeds lie


@dataclass
class ReproductionSettings:
    """Options of ``lerobot-swr-reproduce``."""

    # table1, robustness, contracting, control, scenes, figures, or all of them.
    suite: str = "all"
    # Training steps of bc, zbc and wzbc. The paper's.
    steps: int = 100_000
    # Number of training seeds, 0, 1, ... The paper's.
    seeds: int = 5
    # Rollouts per training seed and way of drawing styles. The paper's.
    n_rollouts: int = 100
    # Frames per training step of bc, zbc and wzbc. The paper's.
    batch_size: int = 16
    # Steps and seeds of the sweeps over beta and p (figures).
    sweep_steps: int = 30_000
    sweep_seeds: int = 2
    # Steps (of each policy's own batch size) and seeds of the other policies, which LeRobot's own loop trains
    # one seed after the other.
    act_steps: int = 10_000
    diffusion_steps: int = 10_000
    baseline_steps: int = 20_000
    baseline_seeds: int = 2
    # Only these datasets; null takes the paper's. A suite that is named takes datasets of your own as well.
    datasets: list[str] | None = None
    # Folder with the D3IL benchmark's human recordings of avoiding (*.pkl): adds the datasets
    # d3il_human_avoiding and d3il_human_unbalanced_avoiding, which are made of them.
    from_d3il: Path | None = None
    # Only these policies.
    policies: list[str] | None = None
    # Options of bc, zbc and wzbc that differ from their defaults, e.g. {backbone.hidden_dim: 64}.
    policy_options: dict[str, Any] = field(default_factory=dict)
    # Where everything is written.
    output_dir: Path = Path("outputs/reproduction")
    # Folder of the datasets, by name; absent ones of the package are made. null: OUTPUT_DIR/datasets.
    dataset_dir: Path | None = None
    # Trainings and evaluations that run at once, one thread each; null takes joblib's active configuration.
    jobs: int | None = os.cpu_count()
    # Make absent datasets, print what is done and what is waiting, and end.
    dry_run: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        if self.suite not in (*SUITES, "all"):
            raise ValueError(f"suite={self.suite!r}: expected one of {', '.join(SUITES)} or all")
        for key in (
            "steps",
            "seeds",
            "n_rollouts",
            "batch_size",
            "sweep_steps",
            "sweep_seeds",
            "act_steps",
            "diffusion_steps",
            "baseline_steps",
            "baseline_seeds",
        ):
            if getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected at least 1")
        if self.n_rollouts > MAX_ROLLOUTS:
            raise ValueError(f"n_rollouts={self.n_rollouts}: expected at most {MAX_ROLLOUTS:,}")
        if self.jobs is not None and self.jobs == 0:
            raise ValueError("jobs=0: expected a number of processes, or -1 for all cores")
        for key in ("datasets", "policies"):
            if getattr(self, key) is not None and not getattr(self, key):
                raise ValueError(f"{key}=[]: nothing would be left; leave it out for all")

    @property
    def suites(self) -> tuple[str, ...]:
        """The suites to run."""
        return SUITES if self.suite == "all" else (self.suite,)

    @property
    def dataset_folder(self) -> Path:
        """Where datasets are looked for and made."""
        return self.dataset_dir or self.output_dir / "datasets"

    def choose_datasets(self, of_the_suite: tuple[str, ...]) -> tuple[str, ...]:
        """The datasets of a suite, given those that it has by default."""
        if self.datasets is None:
            return of_the_suite
        if self.suite != "all":
            return tuple(self.datasets)
        return tuple(name for name in of_the_suite if name in self.datasets)

    def choose_policies(self, of_the_suite: tuple[str, ...]) -> tuple[str, ...]:
        """The policies of a suite, given those that it has by default.

        Raises:
            ValueError: If a policy is asked for that no suite knows.
        """
        if self.policies is None:
            return of_the_suite
        return tuple(name for name in of_the_suite if name in self.policies)
