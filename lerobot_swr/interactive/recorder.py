"""Recording mode: which attempts are kept, what they show, and what has been saved."""

from collections import Counter
from inspect import isfunction
from pathlib import Path
from typing import Any

from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_swr.behaviors import DATASET_RULES, BehaviorRule
from lerobot_swr.demos.catalog import RECIPES
from lerobot_swr.demos.writer import DatasetKind, DemonstrationWriter
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_demonstrations
from lerobot_swr.interactive.session import Session


def dataset_kind(session: Session) -> DatasetKind:
    """What is recorded in a session: as this package's own datasets of the environment, where it has some.

    Raises:
        ValueError: If the environment shows pictures, which are not recorded.
    """
    if session.shows_pictures:
        raise ValueError(
            "the environment observes pictures, which are not recorded here: choose another --env.obs_type"
        )
    config, observations = session.task.env_cfg, session.scene.observations
    robot_type, fps = f"{config.type}_{config.task}", int(config.fps)
    robot_type = robot_type if robot_type in DATASET_RULES else config.type
    shapes = {key: len(value) for key, value in observations.items()} | {ACTION: session.action_dim}
    for recipe in RECIPES.values():
        sizes = {key: len(names) for key, names in recipe.features.items()}
        if recipe.robot_type.startswith(f"{config.type}_") and sizes == shapes:
            return DatasetKind(fps, robot_type, recipe.instruction, recipe.features)
    names = {OBS_STATE: "state", OBS_ENV_STATE: "scene", ACTION: "action"}
    features = {
        key: [f"{names.get(key, key.rpartition('.')[2])}_{i}" for i in range(size)]
        for key, size in shapes.items()
    }
    return DatasetKind(fps, robot_type, session.instruction or robot_type, features)


class Recorder:
    """Keeps successes of a session and saves them into a dataset.

    Args:
        session: Where the person acts.
        root: Folder of the dataset, new or begun.
        repo_id: Name of the dataset.

    Attributes:
        root: As given.
        saved: Histogram of the dataset's behaviours.
        kept: That of the demonstrations that are kept and not saved yet.
    """

    def __init__(self, session: Session, root: Path, repo_id: str | None = None):
        self._session, self.root = session, root
        self.writer = DemonstrationWriter(root, dataset_kind(session), repo_id)
        self.saved: Counter[str] = Counter()
        if self.writer.n_saved:
            meta = DatasetSource(root, repo_id).metadata()
            self.saved.update(map(self._label, load_demonstrations(meta).episodes()))
        self._labels = [self._label(one.observations) for one in self.writer.kept()]

    @property
    def kept(self) -> Counter[str]:
        """Histogram of what is kept and not saved yet."""
        return Counter(self._labels)

    @property
    def behavior_rule(self) -> str | None:
        """The rule as ``module:function``, where a training could not know it from the dataset."""
        rule = self._session.rule
        if not isfunction(rule) or self.writer.kind.robot_type in DATASET_RULES:
            return None
        return f"{rule.__module__}:{rule.__qualname__}"

    def keep(self) -> None:
        """Keep the episode that has just ended.

        Raises:
            ValueError: If it was no success.
        """
        if not (self._session.scene.over and self._session.scene.success):
            raise ValueError("only a success can be kept: reach the goal first")
        self.writer.keep(self._session.recording())
        self._labels.append(self._session.behavior())

    def undo(self) -> None:
        """Throw away what was kept last.

        Raises:
            ValueError: If nothing is kept that is not saved.
        """
        if not self.writer.undo():
            raise ValueError("there is nothing to take back: what is saved stays")
        self._labels.pop()

    def save(self) -> int:
        """Write what is kept into the dataset; the number of its episodes then."""
        total = self.writer.save()
        self.saved.update(self._labels)
        self._labels = []
        return total

    def state(self) -> dict[str, Any]:
        """What the page shows of the recording."""
        return {
            "root": str(self.root),
            "saved": dict(self.saved),
            "kept": dict(self.kept),
            "n_saved": sum(self.saved.values()),
            "n_kept": len(self._labels),
        }

    def _label(self, observations: Any) -> str:
        rule: BehaviorRule | None = self._session.rule
        return rule(observations) if rule else "success"
