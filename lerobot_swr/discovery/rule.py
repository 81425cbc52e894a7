"""``behaviors.json``: what was found, as a file and as a behaviour rule.

A new episode gets the behaviour of the nearest known episode; one that is farther from it than `reach`
allows, or whose nearest is an outlier, is an outlier. A rollout may end when its task is done, a little
earlier than the demonstrations: then it is compared with their ways up to there.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from lerobot_swr.discovery.discover import OUTLIER, Discovery
from lerobot_swr.discovery.features import Features, rounded
from lerobot_swr.whole_files import write_whole

RULE_FILE = "behaviors.json"
VERSION = 1
EARLY = (0.95, 0.9, 0.85)  # shares of a known episode's way after which a new one may end
COMPARED = 200  # known episodes, the nearest, with which one that ends early is compared


@dataclass(frozen=True)
class DiscoveredRule:
    """Labels an episode by the behaviours that were found in a dataset.

    Attributes:
        features: What episodes are compared by.
        names: K names.
        groups: (N,) behaviour of each known episode, -1 for outliers.
        places: (N, k) their places along the main directions.
        reach: (K,) largest distance at which a new episode belongs to a behaviour.
    """

    features: Features
    names: tuple[str, ...]
    groups: np.ndarray
    places: np.ndarray
    reach: np.ndarray

    def __call__(self, observations: Mapping[str, np.ndarray]) -> str:
        """The name of the episode's behaviour, or ``outlier``.

        Raises:
            ValueError: If the episode lacks what the behaviours were found by.
        """
        new = self.features.embed(observations)
        distances = np.linalg.norm(self.places - new.place, axis=1)
        nearest = int(distances.argmin())
        group = int(self.groups[nearest])
        far = float(np.hypot(distances[nearest], new.off)) > self.reach[group]
        if group < 0 or (far and self.features.points == 1):
            return OUTLIER
        if not far:
            return self.names[group]
        some = np.argsort(distances)[:COMPARED]
        some = some[self.groups[some] >= 0]
        early = np.array([self.features.beside(new, self.places[some], share) for share in EARLY])
        group = int(self.groups[some[early.min(axis=0).argmin()]])
        return self.names[group] if early.min() <= self.reach[group] else OUTLIER

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read ``behaviors.json``.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is no such file, or damaged.
        """
        data = read_rule_file(path)
        try:
            return cls(
                Features.from_json(data["features"]),
                tuple(data["names"]),
                np.array(data["examples"]["behavior"], int),
                np.array(data["examples"]["places"], float).reshape(len(data["examples"]["behavior"]), -1),
                np.array(data["reach"], float),
            )
        except (KeyError, TypeError, IndexError) as error:
            raise ValueError(f"behavior_rule={str(path)!r}: damaged ({error!r}); make it anew") from error


def read_rule_file(path: Path) -> dict[str, Any]:
    """The content of ``behaviors.json``.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is something else.
    """
    if not path.is_file():
        raise FileNotFoundError(
            f"behavior_rule={str(path)!r} does not exist; make it with lerobot-swr-behaviors "
            "--dataset.root=DATASET --output_dir=FOLDER"
        )
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"behavior_rule={str(path)!r} is no JSON ({error})") from error
    if not isinstance(data, dict) or "examples" not in data or "features" not in data:
        raise ValueError(
            f"behavior_rule={str(path)!r} was not written by lerobot-swr-behaviors (an evaluation's "
            "results, which have the same name, are no rule)"
        )
    if data.get("version", 0) > VERSION:
        raise ValueError(f"behavior_rule={str(path)!r}: made by a later version of this package; update it")
    return data


def rule_data(discovery: Discovery, dataset: str) -> dict[str, Any]:
    """What ``behaviors.json`` holds.

    Args:
        discovery: The behaviours.
        dataset: Folder of the dataset.
    """
    counts = [int((discovery.groups == k).sum()) for k in range(len(discovery.names))]
    return {
        "version": VERSION,
        "dataset": dataset,
        "names": list(discovery.names),
        "labels": discovery.labels,
        "counts": counts,
        "medoids": list(discovery.medoids),
        "outliers": {str(episode): why for episode, why in discovery.reasons.items()},
        "separation": round(discovery.separation, 4),
        "stability": round(discovery.stability, 4),
        "reach": rounded(discovery.reach),
        "features": discovery.features.to_json(),
        "examples": {"behavior": discovery.groups.tolist(), "places": rounded(discovery.places)},
    }


def write_rule(path: Path, data: Mapping[str, Any]) -> None:
    """Write ``behaviors.json``, all or nothing."""
    write_whole(path, json.dumps(data, ensure_ascii=False) + "\n")
