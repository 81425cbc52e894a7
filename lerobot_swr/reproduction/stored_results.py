"""Finished cells as the report reads them: from the files alone, without datasets or checkpoints."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lerobot_swr.evaluation.metrics import Histogram, histogram
from lerobot_swr.reproduction.cells import Labels
from lerobot_swr.reproduction.summary import Summary, summarize


@dataclass(frozen=True)
class DatasetDescription:
    """A dataset as its cell describes it.

    Attributes:
        name: Its name.
        env: Options of its environment.
        result: What its cell holds.
    """

    name: str
    env: Mapping[str, Any]
    result: Mapping[str, Any]

    @cached_property
    def histogram(self) -> Histogram:
        """Label to share of the demonstrations."""
        return histogram(self.result["behavior"])

    @property
    def same_by_chance(self) -> float:
        """Share of pairs of demonstrations with the same behaviour."""
        labels = self.result["behavior"]
        pairs = sum(labels.count(label) - 1 for label in labels)
        return pairs / (len(labels) * (len(labels) - 1))


@dataclass(frozen=True)
class StoredCell:
    """A finished cell.

    Attributes:
        kind: Of the cell.
        key: Of the cell.
        needs: Key of its training.
        labels: How it is called.
        definition: What defines it.
        result: What it found.
        provenance: Seconds and versions.
        demonstrations: Its dataset.
        training: Definition of the training it needs.
    """

    kind: str
    key: str
    needs: str | None
    labels: Labels
    definition: Mapping[str, Any]
    result: Mapping[str, Any]
    provenance: Mapping[str, Any]
    demonstrations: DatasetDescription
    training: Mapping[str, Any] | None

    @property
    def policy(self) -> str:
        """Type of the policy, without what differs from its usual options."""
        return self.labels.policy.split(" ")[0]

    @cached_property
    def protocols(self) -> list[str]:
        """Ways of drawing styles that an evaluation has, the last one the better one to compare with."""
        return list(self.definition["protocols"])

    @cached_property
    def summaries(self) -> dict[str, Summary]:
        """Of an evaluation, by way of drawing styles."""
        described = self.demonstrations.result
        labels, steps = described["behavior"], described["steps_to_end"]
        return {protocol: summarize(self.result, protocol, labels, steps) for protocol in self.protocols}

    @property
    def best(self) -> Summary:
        """The evaluation with each style once where the policy has styles, else its only one."""
        return self.summaries[self.protocols[-1]]


@dataclass(frozen=True)
class SuiteResults:
    """What is there of a suite.

    Attributes:
        name: Of the suite.
        command: That ran it last.
        cells: Finished cells, in the suite's order.
        missing: File names of those that are not finished.
        datasets: Descriptions by name.
        files: Names of the files that all this was read from.
    """

    name: str
    command: str
    cells: list[StoredCell]
    missing: list[str]
    datasets: dict[str, DatasetDescription]
    files: list[str]

    def evaluations(self, dataset: str) -> list[StoredCell]:
        """The finished evaluations on a dataset."""
        return [c for c in self.cells if c.kind == "evaluate" and c.labels.dataset == dataset]

    def of_kind(self, kind: str, dataset: str) -> list[StoredCell]:
        """The finished cells of another kind on a dataset."""
        return [c for c in self.cells if c.kind == kind and c.labels.dataset == dataset]


def load_suites(root: Path) -> dict[str, SuiteResults]:
    """The suites whose runs have left results in a folder.

    Raises:
        FileNotFoundError: If there are none.
    """
    manifests = sorted((root / "suites").glob("*.json"))
    if not manifests:
        raise FileNotFoundError(f"{str(root)!r}: no suites/*.json there; run lerobot-swr-reproduce first")
    return {path.stem: _load_suite(root, json.loads(path.read_text())) for path in manifests}


def _load_suite(root: Path, manifest: Mapping[str, Any]) -> SuiteResults:
    def read(name: str) -> dict[str, Any]:
        return json.loads((root / "results" / name).read_text())

    datasets = {}
    for name, file in manifest["datasets"].items():
        stored = read(file)
        datasets[name] = DatasetDescription(name, stored["definition"]["env"], stored["result"])
    present = [name for name in manifest["cells"] if (root / "results" / name).is_file()]
    raw = [read(name) for name in present]
    trainings = {stored["key"]: stored["definition"] for stored in raw if stored["kind"] == "train"}
    cells = [
        StoredCell(
            kind=stored["kind"],
            key=stored["key"],
            needs=stored["needs"],
            labels=Labels(**stored["labels"]),
            definition=stored["definition"],
            result=stored["result"],
            provenance=stored["provenance"],
            demonstrations=datasets[stored["labels"]["dataset"]],
            training=trainings.get(stored["needs"]),
        )
        for stored in raw
    ]
    missing = [name for name in manifest["cells"] if name not in present]
    files = [*manifest["datasets"].values(), *present]
    return SuiteResults(manifest["suite"], manifest["command"], cells, missing, datasets, files)
