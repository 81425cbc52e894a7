"""The runs of several seeds on disk: one ordinary LeRobot run per seed."""

import json
import os
import shutil
from pathlib import Path

from lerobot.common.train_utils import (
    get_step_checkpoint_dir,
    load_training_state,
    save_checkpoint,
)
from lerobot.configs import PreTrainedConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.datasets import LeRobotDatasetMetadata
from lerobot.optim.factory import make_optimizer_and_scheduler
from lerobot.policies import make_policy, make_pre_post_processors
from lerobot.processor import PolicyProcessorPipeline
from lerobot.utils.constants import (
    CHECKPOINTS_DIR,
    LAST_CHECKPOINT_LINK,
    OPTIMIZER_PARAM_GROUPS,
    PRETRAINED_MODEL_DIR,
    SCHEDULER_STATE,
    TRAINING_STATE_DIR,
)
from lerobot.utils.random_utils import set_seed

from lerobot_swr.policies.style_policy import StylePolicy
from lerobot_swr.run_context import running
from lerobot_swr.training.configuration_training import OPTIONS_FILE, SeedsTrainConfig, is_begun
from lerobot_swr.training.stacked_policies import StackedPolicies
from lerobot_swr.whole_files import write_whole


def check_options(config: SeedsTrainConfig) -> None:
    """Remember the options in the output folder; refuse to go on there with others.

    Options of a command that has not written a checkpoint yet are forgotten.

    Raises:
        ValueError: Naming the options in which the interrupted command differs from this one.
    """
    assert config.output_dir is not None
    file, options = config.output_dir / OPTIONS_FILE, json.loads(json.dumps(config.decisive_options()))
    if file.is_file() and is_begun(config.output_dir):
        known = json.loads(file.read_text())
        changed = sorted(key for key in options.keys() & known.keys() if options[key] != known[key])
        if changed:
            raise ValueError(
                f"output_dir={str(config.output_dir)!r} was begun with other values of {', '.join(changed)} "
                f"(see {OPTIONS_FILE}); resume with those, or choose another folder"
            )
        return
    write_whole(file, json.dumps(options, indent=2))


def last_step(run: TrainPipelineConfig) -> int:
    """Step of a run's last complete checkpoint, 0 if there is none."""
    assert run.output_dir is not None
    folder = run.output_dir / CHECKPOINTS_DIR
    steps = [int(path.name) for path in folder.iterdir() if path.name.isdigit()] if folder.is_dir() else []
    return max((step for step in steps if _is_complete(run, step)), default=0)


def checkpoint_folder(run: TrainPipelineConfig, step: int) -> Path:
    """Folder of a run's checkpoint."""
    assert run.output_dir is not None
    return get_step_checkpoint_dir(run.output_dir, run.steps, step)


def _is_complete(run: TrainPipelineConfig, step: int) -> bool:
    """Whether the file that LeRobot writes last is whole; its own command writes in place."""
    state = checkpoint_folder(run, step) / TRAINING_STATE_DIR
    name = OPTIMIZER_PARAM_GROUPS if run.scheduler is None else SCHEDULER_STATE
    files = list(state.rglob(name))  # several optimizers have a folder each
    try:
        return bool([json.loads(file.read_text()) for file in files])
    except json.JSONDecodeError:
        return False


def drop_incomplete(run: TrainPipelineConfig) -> None:
    """Delete the checkpoints after the last complete one, and without one all that the run has written."""
    assert run.output_dir is not None
    step = last_step(run)
    if not step:
        shutil.rmtree(run.output_dir, ignore_errors=True)
        return
    for folder in (run.output_dir / CHECKPOINTS_DIR).iterdir():
        if folder.name.isdigit() and int(folder.name) > step:
            shutil.rmtree(folder)


def point_to_last(run: TrainPipelineConfig) -> Path:
    """Let ``checkpoints/last`` name the last complete checkpoint; returns its policy's folder."""
    folder = checkpoint_folder(run, last_step(run))
    link = folder.parent / LAST_CHECKPOINT_LINK
    temporary = link.with_name(f".{link.name}.{os.getpid()}")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(folder.name)
    os.replace(temporary, link)
    return link / PRETRAINED_MODEL_DIR


class SeedRuns:
    """The runs of some seeds, at the same step: policies, processors and optimizers, new or resumed.

    Attributes:
        step: Steps that are done.
        policies: K policies in training mode.
        preprocessor: Their inputs of raw frames.
        stack: The policies as one.

    Args:
        config: The command's configuration.
        seeds: K seeds whose last checkpoints are of the same step.
        meta: The dataset's metadata.
    """

    def __init__(self, config: SeedsTrainConfig, seeds: list[int], meta: LeRobotDatasetMetadata):
        self.runs = [config.of_seed(seed) for seed in seeds]
        self.step = last_step(self.runs[0])
        self.policies: list[StylePolicy] = []
        optimizers, scheduler = [], None
        for run in self.runs:
            policy = self._make_policy(run, meta)
            optimizer, schedule = make_optimizer_and_scheduler(run, policy)
            if self.step:
                load_training_state(checkpoint_folder(run, self.step), optimizer, schedule)
            self.policies.append(policy.train())
            optimizers.append(optimizer)
            scheduler = scheduler or schedule
        self.preprocessor, self._postprocessor = self._make_processors(self.runs[0], meta)
        self.stack = StackedPolicies(self.policies, optimizers, scheduler, self.runs[0])

    def _make_policy(self, run: TrainPipelineConfig, meta: LeRobotDatasetMetadata) -> StylePolicy:
        assert run.seed is not None
        if self.step:
            path = checkpoint_folder(run, self.step) / PRETRAINED_MODEL_DIR
            run.policy = PreTrainedConfig.from_pretrained(path)
            run.policy.pretrained_path = path
        assert run.policy is not None
        set_seed(run.seed)  # as lerobot-train does, so that the policy starts from the same weights
        with running(run.dataset, resuming=bool(self.step)):
            policy = make_policy(run.policy, ds_meta=meta)
        assert isinstance(policy, StylePolicy)
        return policy

    def _make_processors(
        self, run: TrainPipelineConfig, meta: LeRobotDatasetMetadata
    ) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        policy = self.policies[0]
        path = run.policy.pretrained_path if run.policy is not None else None
        if path is None or self.step:
            statistics = {} if self.step else {"dataset_stats": meta.stats}
            return make_pre_post_processors(policy.config, path, **statistics)
        # Fine-tuning: the checkpoint's pipelines with the statistics of this dataset.
        outputs = {"features": policy.config.output_features, "norm_map": policy.config.normalization_mapping}
        inputs = {**outputs, "features": {**policy.config.input_features, **policy.config.output_features}}
        return make_pre_post_processors(
            policy.config,
            path,
            dataset_stats=meta.stats,
            preprocessor_overrides={
                "device_processor": {"device": str(policy.config.device)},
                "normalizer_processor": {**inputs, "stats": meta.stats},
            },
            postprocessor_overrides={"unnormalizer_processor": {**outputs, "stats": meta.stats}},
        )

    def save(self) -> None:
        """Write a checkpoint of every run; one that is under way when the process ends leaves nothing."""
        self.stack.unstack()
        for k, (run, policy) in enumerate(zip(self.runs, self.policies, strict=True)):
            folder = checkpoint_folder(run, self.step)
            unfinished = folder.with_name(f".{folder.name}.unfinished")
            shutil.rmtree(unfinished, ignore_errors=True)
            assert run.seed is not None
            # Training draws nothing from the global generator; a run that goes on from here finds it seeded.
            set_seed(run.seed)
            save_checkpoint(
                unfinished,
                self.step,
                run,
                policy,
                self.stack.optimizer,
                self.stack.scheduler,
                self.preprocessor,
                self._postprocessor,
                num_processes=1,
                batch_size=run.batch_size,
                optim_state_dict=self.stack.optimizer_state(k),
            )
            if folder.exists():  # incomplete
                shutil.rmtree(folder)
            os.replace(unfinished, folder)
            point_to_last(run)
