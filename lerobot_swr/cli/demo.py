"""``lerobot-swr-demo``: the whole story in ten minutes on a laptop.

Makes datasets of two mazes and of a robot arm among obstacles, trains BC, ZBC and WZBC on each with
``lerobot-swr-train``, compares their behaviours with the demonstrations and writes one HTML page. Datasets
and finished trainings in the output folder are used again.
"""

import os
import re
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.utils import init_logging

from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.demos.catalog import get_recipe
from lerobot_swr.demos.dataset_writer import write_dataset
from lerobot_swr.envs.d3il.configuration_d3il import D3ILEnvConfig
from lerobot_swr.envs.maze2d.configuration_maze2d import Maze2DEnvConfig
from lerobot_swr.envs.task import task_of
from lerobot_swr.evaluation.behavior_evaluation import BehaviorResult
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_checkpoint, load_reference
from lerobot_swr.evaluation.checks.behaviors import Comparison, compare
from lerobot_swr.evaluation.plots import plot_behaviors, plot_comparison
from lerobot_swr.evaluation.report import Picture, Section, Table, write_report
from lerobot_swr.evaluation.results import write_json
from lerobot_swr.evaluation.rollouts import RolloutOptions
from lerobot_swr.installation import unmet_requirements
from lerobot_swr.progress import Progress

DATASETS: dict[str, EnvConfig] = {
    "medium_maze-one_side": Maze2DEnvConfig(task="medium"),
    "medium_maze-only_forward": Maze2DEnvConfig(task="medium"),
    "d3il_avoiding": D3ILEnvConfig(task="avoiding"),
}
HEADER = (
    "policy",
    "steps",
    "L1 uniform",
    "floor",
    "L1 stratified",
    "success",
    "95 % interval",
    "style fidelity",
)


@dataclass
class DemoCommand:
    """Options of ``lerobot-swr-demo``."""

    # Where datasets, trainings and the report go.
    output_dir: Path = Path("outputs/demo")
    # Only these of medium_maze-one_side, medium_maze-only_forward and d3il_avoiding; null takes all for which
    # the packages are installed.
    datasets: list[str] | None = None
    # Training steps of each policy: of zbc and wzbc the paper's, as in the results of the README.
    bc_steps: int = 20_000
    zbc_steps: int = 100_000
    wzbc_steps: int = 100_000
    # Rollouts per evaluation.
    n_episodes: int = 100
    # Trainings that run at once.
    jobs: int = os.cpu_count() or 1
    seed: int = 1000


@dataclass(frozen=True)
class Training:
    """One run of ``lerobot-swr-train``."""

    policy: str
    dataset: str
    steps: int
    command: tuple[str, ...]
    output_dir: Path
    seed: int

    @property
    def checkpoint(self) -> Path:
        """The trained policy."""
        return (
            self.output_dir / f"seed_{self.seed}" / "checkpoints" / f"{self.steps:06d}" / "pretrained_model"
        )

    @property
    def log(self) -> Path:
        """What the run prints."""
        return self.output_dir.with_suffix(".log")


@parser.wrap()
def demo(cfg: DemoCommand) -> None:
    """Make datasets, train, evaluate, report."""
    start = time.monotonic()
    datasets = _datasets(cfg)
    for dataset in datasets:
        root = cfg.output_dir / dataset
        if not (root / "meta" / "info.json").is_file():
            write_dataset(get_recipe(dataset), root, seed=0)
    trainings = [_training(cfg, policy, dataset) for policy in ("wzbc", "zbc", "bc") for dataset in datasets]
    _train_all(trainings, cfg.jobs)
    sections = [_evaluate(cfg, dataset, trainings) for dataset in datasets]
    report = cfg.output_dir / "report.html"
    write_report(
        report,
        "Reproducing the diversity of demonstrations",
        "Each policy is trained on demonstrations that solve one task in several ways. L1 is the distance "
        "between the behaviour histograms of demonstrations and rollouts, 0 (equal) to 2 (disjoint). With "
        "styles drawn uniformly even a perfect reproducer scores the floor; with each style used once "
        "(stratified) its L1 is 0. One training seed per policy: differences of a few hundredths are noise.",
        sections,
        ["lerobot-swr-demo " + " ".join(sys.argv[1:])] + [" ".join(t.command) for t in trainings],
        ", ".join(f"{name} {version(name)}" for name in ("lerobot_policy_swr", "lerobot", "torch")),
    )
    for section in sections:
        print(f"\n{section.title}")
        for row in (section.tables[0].header, *section.tables[0].rows):
            print("  ".join(f"{cell:>14}" for cell in row))
    print(f"\n{(time.monotonic() - start) / 60:.1f} minutes; report: {report.resolve()}")


def _datasets(cfg: DemoCommand) -> list[str]:
    """The datasets to show, longest trainings first.

    Raises:
        ValueError: If one is unknown.
    """
    unknown = [name for name in cfg.datasets or [] if name not in DATASETS]
    if unknown:
        raise ValueError(f"datasets={cfg.datasets}: {unknown} are not among {', '.join(DATASETS)}")
    chosen = cfg.datasets or list(DATASETS)
    missing = unmet_requirements(extra="d3il") if "d3il_avoiding" in chosen else []
    if missing and cfg.datasets is None:
        chosen.remove("d3il_avoiding")
        print(f"left out: d3il_avoiding (needs {', '.join(missing)}: pip install 'lerobot_policy_swr[d3il]')")
    return chosen


def _training(cfg: DemoCommand, policy: str, dataset: str) -> Training:
    steps = {"bc": cfg.bc_steps, "zbc": cfg.zbc_steps, "wzbc": cfg.wzbc_steps}[policy]
    output_dir = cfg.output_dir / "train" / f"{dataset}-{policy}-{steps}-seed{cfg.seed}"
    command = (
        "lerobot-swr-train",
        f"--seeds={cfg.seed}",
        "--jobs=1",
        f"--policy.type={policy}",
        "--policy.device=cpu",
        "--policy.push_to_hub=false",
        f"--dataset.repo_id=local/{dataset}",
        f"--dataset.root={cfg.output_dir / dataset}",
        "--batch_size=16",
        f"--steps={steps}",
        f"--save_freq={steps}",
        "--log_freq=0",
        f"--output_dir={output_dir}",
    )
    return Training(policy, dataset, steps, command, output_dir, cfg.seed)


def _train_all(trainings: list[Training], jobs: int) -> None:
    """Run what is not finished, several at once, with one progress bar over all steps.

    Raises:
        ChildProcessError: If a training fails; its log says why.
    """
    waiting = [training for training in trainings if not training.checkpoint.is_dir()]
    total = sum(training.steps for training in waiting)
    running: set[subprocess.Popen] = set()
    with ThreadPoolExecutor(jobs) as pool, Progress(total=total, desc="Training", unit="step") as bar:
        futures = [pool.submit(_train, training, running) for training in waiting]
        try:
            while not all(future.done() for future in futures):
                time.sleep(1)
                bar.update(sum(map(_steps_done, waiting)) - bar.n)
            for future in as_completed(futures):
                future.result()
        except BaseException:  # Ctrl-C or a failure: end what is under way instead of waiting for it
            pool.shutdown(wait=False, cancel_futures=True)
            for process in running:
                process.terminate()
            raise


def _train(training: Training, running: set[subprocess.Popen]) -> None:
    if training.output_dir.exists():  # an interrupted run
        shutil.rmtree(training.output_dir)
    training.log.parent.mkdir(parents=True, exist_ok=True)
    one_thread = {**os.environ, "OMP_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1"}
    command = [sys.executable, "-c", "from lerobot_swr.cli.train import main; main()", *training.command[1:]]
    with (
        training.log.open("w") as log,
        subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=one_thread) as process,
    ):
        running.add(process)
        status = process.wait()
        running.discard(process)
    if status != 0:
        raise ChildProcessError(
            f"training {training.policy} on {training.dataset} failed: see {training.log}"
        )


def _steps_done(training: Training) -> int:
    """Steps that a run's progress bar has shown so far."""
    if training.checkpoint.is_dir():
        return training.steps
    if not training.log.is_file():
        return 0
    shown = re.findall(rf"(\d+)/{training.steps} \[", training.log.read_text(errors="replace"))
    return int(shown[-1]) if shown else 0


def _evaluate(cfg: DemoCommand, dataset: str, trainings: list[Training]) -> Section:
    rows, panels, pictures = [], {}, []
    env_cfg = DATASETS[dataset]
    demonstrations: list = []
    for training in reversed([t for t in trainings if t.dataset == dataset]):
        results: dict[str, BehaviorResult] = {}
        for sampling in ("uniform", "stratified"):
            comparison = _compare(cfg, training, env_cfg, sampling)
            results[sampling] = comparison.result
            folder = cfg.output_dir / "eval" / f"{dataset}-{training.policy}-{sampling}"
            write_json(folder / "behaviors.json", comparison.result, {"checkpoint": str(training.checkpoint)})
        plot_behaviors(
            folder / "behaviors.png",
            comparison.demonstrations,
            comparison.rollouts,
            comparison.result.reference_histogram,
            comparison.result.histogram,
            env_cfg,
            f"{training.policy} on {dataset}, {training.steps} steps",
        )
        rows.append(_row(training, results))
        panels[f"{training.policy}: L1 {comparison.result.l1:.2f}"] = comparison.rollouts
        demonstrations = comparison.demonstrations
        styles = "" if training.policy == "bc" else ", each demonstration's style used once"
        pictures.append(
            Picture(f"{training.policy}: {cfg.n_episodes} rollouts{styles}.", folder / "behaviors.png")
        )
    overview = cfg.output_dir / "eval" / f"{dataset}.png"
    plot_comparison(overview, demonstrations, panels, env_cfg, "")
    caption = (
        f"{dataset}: {cfg.n_episodes} rollouts per cell, one training seed; success with Wilson's interval"
    )
    return Section(
        dataset,
        [Table(caption, HEADER, rows)],
        [Picture("Paths by behaviour: demonstrations and policies.", overview), *pictures],
    )


def _compare(cfg: DemoCommand, training: Training, env_cfg: EnvConfig, sampling: str) -> Comparison:
    policy_cfg = PreTrainedConfig.from_pretrained(training.checkpoint)
    policy_cfg.pretrained_path = training.checkpoint
    if hasattr(policy_cfg, "style_sampling"):
        policy_cfg.style_sampling = sampling
    checkpoint = load_checkpoint(policy_cfg)
    trajectories = load_reference(DatasetSource(root=cfg.output_dir / training.dataset), checkpoint)
    rule = task_of(env_cfg).behavior_rule()
    options = RolloutOptions(n_episodes=cfg.n_episodes, seed=cfg.seed)
    return compare(checkpoint, trajectories, env_cfg, rule, options)


def _row(training: Training, results: dict[str, BehaviorResult]) -> list[str]:
    uniform, stratified = results["uniform"], results["stratified"]
    has_styles = stratified.style_fidelity is not None
    interval = stratified.success_interval
    return [
        training.policy,
        f"{training.steps}",
        f"{uniform.l1:.3f}",
        f"{uniform.l1_floor:.3f}",
        f"{stratified.l1:.3f}" if has_styles else "-",
        f"{stratified.success_rate:.2f}",
        f"{interval.low:.2f} to {interval.high:.2f}",
        f"{stratified.style_fidelity:.2f}" if has_styles else "-",
    ]


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging(console_level="WARNING")
    demo()


if __name__ == "__main__":
    main()
