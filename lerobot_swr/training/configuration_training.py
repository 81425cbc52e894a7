"""LeRobot's training configuration, with several seeds."""

import copy
import os
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import draccus
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig

from lerobot_swr.configuration import check_checkpoint_path, check_dataset_folder
from lerobot_swr.policies.configuration_swr import BCConfig

OPTIONS_FILE = "seeds_train_config.json"
DECISIVE = (
    *("dataset", "policy", "batch_size", "steps"),
    *("optimizer", "scheduler", "use_policy_training_preset"),
    *("peft", "sample_weighting", "rename_map", "cudnn_deterministic"),
)


@dataclass
class SeedsTrainConfig(TrainPipelineConfig):
    """Options of ``lerobot-swr-train``: those of ``lerobot-train``, and the seeds."""

    # One run is trained for each, as `lerobot-train --seed=…` would, into output_dir/seed_<seed>.
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])
    # Train bc, zbc and wzbc with their seeds stacked, many times faster; false trains them one by one in
    # LeRobot's own loop, which learns the same up to rounding.
    stack: bool = True
    # Processes over which the seeds are spread; null takes one per core.
    jobs: int | None = None

    def validate(self) -> None:
        """Check the values and fill in defaults.

        Raises:
            ValueError: For an option that only ``lerobot-train`` has, or a bad value.
            FileExistsError: If the output folder exists and ``resume`` is not set.
        """
        check_dataset_folder()
        path = parser.get_path_arg("policy")
        if path is not None:
            check_checkpoint_path(path)
        # LeRobot resumes one run from its config_path; this command finds its runs in output_dir.
        new_run = self._as_plain(resume=False, output_dir=None)
        new_run.validate()
        filled = ["policy", "optimizer", "scheduler", "job_name"]
        for key in filled if self.output_dir else [*filled, "output_dir"]:
            setattr(self, key, getattr(new_run, key))
        assert self.output_dir is not None
        if not self.resume and self.output_dir.is_dir() and not _is_untouched(self.output_dir):
            raise FileExistsError(
                f"output_dir={str(self.output_dir)!r} exists; go on with its runs with --resume=true, or "
                "choose another folder"
            )
        if not self.seeds or len(set(self.seeds)) != len(self.seeds) or min(self.seeds) < 0:
            raise ValueError(f"seeds={self.seeds}: expected different numbers >= 0, e.g. --seeds=0,1,2,3,4")
        if self.jobs is None:
            on_cpu = self.policy is not None and self.policy.device == "cpu"
            self.jobs = len(os.sched_getaffinity(0)) if on_cpu and hasattr(os, "sched_getaffinity") else 1
        for key in ("jobs", "steps", "batch_size"):
            if getattr(self, key) < 1:
                raise ValueError(f"{key}={getattr(self, key)}: expected at least 1")
        self._refuse_what_one_run_alone_can_do()

    @property
    def is_stacked(self) -> bool:
        """Whether the seeds are trained as one; other policies go through LeRobot's loop one by one."""
        return self.stack and isinstance(self.policy, BCConfig) and self.policy.traits.is_stackable

    def _refuse_what_one_run_alone_can_do(self) -> None:
        if self.policy is None:
            raise ValueError("a reward model: this command trains policies; use lerobot-train")
        refused = {
            "dataset.streaming": self.dataset.streaming,
            "policy.push_to_hub": self.policy.push_to_hub,
            "save_checkpoint_to_hub": self.save_checkpoint_to_hub,
            "job": self.job.is_remote,
            "save_checkpoint=false": not self.save_checkpoint,
        }
        if self.is_stacked:
            refused |= {
                "eval_steps": self.eval_steps > 0,
                "env": self.env is not None and self.env_eval_freq > 0,
                "wandb.enable": self.wandb.enable,
                "peft": self.peft is not None,
                "sample_weighting": self.sample_weighting is not None,
                "rename_map": bool(self.rename_map),
                "policy.use_amp": self.policy.use_amp,
            }
        given = [key for key, is_given in refused.items() if is_given]
        if given:
            hint = " (--env_eval_freq=0, and evaluate afterwards)" if "env" in given else ""
            raise ValueError(
                f"{', '.join(given)}: not available in lerobot-swr-train; switch off{hint}, "
                "or use lerobot-train"
            )

    def of_seed(self, seed: int) -> TrainPipelineConfig:
        """The configuration of one seed's run, as ``lerobot-train`` would have it."""
        assert self.output_dir is not None
        return self._as_plain(seed=seed, output_dir=self.output_dir / f"seed_{seed}", resume=False)

    def _as_plain(self, **changes: Any) -> TrainPipelineConfig:
        values = {f.name: copy.deepcopy(getattr(self, f.name)) for f in fields(TrainPipelineConfig) if f.init}
        return TrainPipelineConfig(**{**values, **changes})

    def decisive_options(self) -> dict[str, Any]:
        """The options that the trained weights depend on, encoded."""
        options = {key: draccus.encode(getattr(self, key)) for key in DECISIVE}
        # Where the dataset lies does not matter; its content does, and a resumed policy checks that.
        options["dataset"].pop("root")
        return options


def is_begun(output_dir: Path) -> bool:
    """Whether an output folder holds a checkpoint."""
    return any(output_dir.glob("seed_*/checkpoints/*"))


def _is_untouched(output_dir: Path) -> bool:
    """Whether a folder holds nothing but the options of a command that failed at its start."""
    return not is_begun(output_dir) and {path.name for path in output_dir.iterdir()} <= {OPTIONS_FILE}
