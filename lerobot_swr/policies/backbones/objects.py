"""Inputs about objects: where hand and objects are as seen from each other, and actions in an object's frame.

Where an object lies is of no importance to how it is handled. A network that sees the hand from the object,
and says what to do as seen from it, need not learn that from every place.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import ACTION
from torch import Tensor, nn

from lerobot_swr.object_poses import (
    POSITION,
    Names,
    Pose,
    find_poses,
    hand_of,
    into_frame,
    object_of,
    out_of_frame,
)

FITTED = 20_000  # frames that give the features' means and standard deviations
WAVES = 4  # scales at which positions are seen, each half of the one before, from four deviations on
SMALL = 0.02  # of a deviation, from where on the logarithmic features count
TARGET_SHARE = 0.75  # of an action's variance that subtracting the hand's position removes if it is a target
DISPLACEMENT = ("d", "delta_", "v", "vel_", "target_", "")  # what may stand before an action's part

Normalize = Callable[[dict[str, Any]], dict[str, Any]]
"""Normalises raw features (F, d_k), as a policy's preprocessor does."""


class Scene(nn.Module):
    """Raw observations of normalised ones, and the poses in them.

    Args:
        observations: Names of the observations to their dimensions, in order.
        names: Of their dimensions and the action's.
        frame: The object from which hand and actions are seen.
    """

    def __init__(self, observations: Mapping[str, int], names: Names, frame: str):
        super().__init__()
        self.keys = tuple(observations)
        poses = find_poses({key: names[key] for key in self.keys if key in names})
        self.object = object_of(poses, frame, "backbone.frame")
        things = {name: pose for name, pose in poses.items() if name != frame}
        hand = hand_of(things)
        self.hand, self.others = things.pop(hand), list(things.values())
        for i, key in enumerate(self.keys):  # raw = gain · normalised + shift
            self.register_buffer(f"gain_{i}", torch.ones(observations[key]))
            self.register_buffer(f"shift_{i}", torch.zeros(observations[key]))

    def fit(self, normalize: Normalize) -> None:
        """Take over how observations are normalised, which is linear."""
        for i, key in enumerate(self.keys):
            shift, gain = self.get_buffer(f"shift_{i}"), self.get_buffer(f"gain_{i}")
            low, high = linear_map(normalize, key, len(shift))
            gain.copy_(1 / (high - low))
            shift.copy_(-low / (high - low))

    def raw(self, batch: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Raw observations (B, d_k)."""
        pairs = enumerate(self.keys)
        return {k: batch[k] * self.get_buffer(f"gain_{i}") + self.get_buffer(f"shift_{i}") for i, k in pairs}

    def hand_position(self, raw: Mapping[str, Tensor]) -> Tensor:
        """(B, 3)."""
        return self.hand.position(raw[self.hand.key])

    def frame(self, raw: Mapping[str, Tensor]) -> Tensor:
        """(B, 3, 3) how the object from which things are seen is turned."""
        return self.object.rotation(raw[self.object.key])

    def relations(self, raw: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Offsets (B, P) and rotations (B, R) of the things as seen from each other."""

        def place(pose: Pose) -> Tensor:
            return pose.position(raw[pose.key])

        def turn(pose: Pose) -> Tensor:
            return pose.rotation(raw[pose.key])

        hand, centre, frame = place(self.hand), place(self.object), turn(self.object)
        offsets, rotations = [into_frame(hand - centre, frame)], []
        for other in self.others:
            offsets += [into_frame(place(other) - hand, frame), into_frame(place(other) - centre, frame)]
            if other.turns:
                own = turn(other)
                offsets += [into_frame(hand - place(other), own), into_frame(centre - place(other), own)]
                rotations.append(torch.einsum("bji,bjk->bik", frame, own).flatten(1))
        if not self.others or not rotations:
            rotations.append(hand[:, :0])
        return torch.cat(offsets, dim=1), torch.cat(rotations, dim=1)


class ObjectEncoder(nn.Module):
    """Normalised observations, and beside them how hand and objects lie to each other, at several scales.

    Attributes:
        dim: d, number of features.

    Args:
        observations: Names of the observations to their dimensions, in order.
        scene: The things in them.
        multiscale: Whether positions are seen at several scales, and small offsets enlarged.
    """

    def __init__(self, observations: Mapping[str, int], scene: Scene, multiscale: bool):
        super().__init__()
        self.scene, self.multiscale = scene, multiscale
        example = {key: torch.zeros(1, d) for key, d in observations.items()}
        offsets, rotations = scene.relations(example)
        p, r = offsets.shape[1], rotations.shape[1]
        self.dim = sum(observations.values()) + (p * (2 + 2 * WAVES) + 2 * r if multiscale else p + r)
        for name in ("mean", "gain"):  # standardised = gain · (relation - mean)
            self.register_buffer(f"{name}_of_offsets", torch.zeros(p))
            self.register_buffer(f"{name}_of_rotations", torch.zeros(r))

    def fit(self, raw: Mapping[str, Tensor]) -> None:
        """Standardise by frames (F, d_k) of the training dataset."""
        for relations, kind in zip(self.scene.relations(raw), ("offsets", "rotations"), strict=True):
            spread = (relations - relations.mean(dim=0)).square().mean(dim=0).sqrt()
            moves = spread > 1e-6 * relations.abs().amax(dim=0).clamp_min(1e-6)
            self.get_buffer(f"mean_of_{kind}").copy_(relations.mean(dim=0))
            self.get_buffer(f"gain_of_{kind}").copy_(torch.where(moves, 1 / spread.clamp_min(1e-12), 0))

    def forward(self, batch: dict[str, Tensor]) -> Tensor:
        """(B, d) features of normalised observations (B, d_k)."""
        offsets, rotations = self.scene.relations(self.scene.raw(batch))
        gain, turns = self.get_buffer("gain_of_offsets"), self.get_buffer("gain_of_rotations")
        around = (offsets - self.get_buffer("mean_of_offsets")) * gain
        turned = (rotations - self.get_buffer("mean_of_rotations")) * turns
        features = [batch[key] for key in self.scene.keys] + [around, turned]
        if self.multiscale:
            phases = [around * (torch.pi / 2 * 2**k) for k in range(WAVES)]
            features += [wave(phase) for phase in phases for wave in (torch.sin, torch.cos)]
            # Zero is where things coincide, so what is small there is enlarged, not what is near the mean.
            features += [_enlarged(offsets * gain), _enlarged(rotations * turns)]
        return torch.cat(features, dim=1)


def _enlarged(values: Tensor) -> Tensor:
    """Values of the order of 1, small ones enlarged."""
    return values.sign() * torch.log1p(values.abs() / SMALL) / 4


class ObjectActions(nn.Module):
    """Turns outputs of the order of 1 into normalised actions; what moves the hand is seen from an object.

    Args:
        names: Of the action's dimensions.
    """

    def __init__(self, names: Sequence[str]):
        super().__init__()
        self.dimensions = _moving_dimensions(names)
        self.is_target: Tensor
        self.scale: Tensor
        self.register_buffer("scale", torch.ones(3))  # of what is seen from the object
        self.register_buffer("is_target", torch.tensor(False))
        self.register_buffer("gain", torch.ones(len(names)))  # normalised = gain · raw + shift
        self.register_buffer("shift", torch.zeros(len(names)))

    def fit(self, scene: Scene, raw: Mapping[str, Tensor], actions: Tensor, normalize: Normalize) -> None:
        """Find out what actions are: displacements, or where the hand is to go; and their scale.

        Args:
            scene: The things that are observed.
            raw: Frames (F, d_k) of the training dataset.
            actions: (F, A) their raw actions.
            normalize: How actions are normalised.
        """
        low, high = linear_map(normalize, ACTION, len(self.get_buffer("gain")))
        self.get_buffer("gain").copy_(high - low)
        self.get_buffer("shift").copy_(low)
        if not self.dimensions:
            return
        moves, hand = self._spatial(actions), scene.hand_position(raw)
        left, all_of_it = (moves - hand).var(dim=0).sum(), moves.var(dim=0).sum()
        self.is_target.fill_(bool(left < (1 - TARGET_SHARE) * all_of_it))
        seen = into_frame(moves - hand * self.is_target, scene.frame(raw))
        self.scale.copy_(seen.square().mean(dim=0).sqrt().clamp_min(1e-9))

    def forward(self, outputs: Tensor, scene: Scene, raw: Mapping[str, Tensor]) -> Tensor:
        """(B, A) normalised actions of (B, A) outputs, for raw observations (B, d_k) of a scene."""
        if not self.dimensions:
            return outputs
        moves = out_of_frame(self._spatial(outputs) * self.scale, scene.frame(raw))
        moves = moves + scene.hand_position(raw) * self.is_target
        gain, shift = self.get_buffer("gain"), self.get_buffer("shift")
        columns = list(outputs.unbind(dim=1))
        for axis, dimension in enumerate(self.dimensions):
            columns[dimension] = moves[:, axis] * gain[dimension] + shift[dimension]
        return torch.stack(columns, dim=1)

    def _spatial(self, actions: Tensor) -> Tensor:
        """(B, 3) of (B, A); 0 in the height where there is none."""
        moves = actions[:, list(self.dimensions)]
        return nn.functional.pad(moves, (0, 3 - len(self.dimensions)))


def _moving_dimensions(names: Sequence[str]) -> tuple[int, ...]:
    """Dimensions of an action that move the hand along x, y (and z); empty where names do not say."""
    for before in DISPLACEMENT:
        wanted = [f"{before}{part}" for part in POSITION]
        places = [list(names).index(name) for name in wanted if name in names]
        if len(places) >= 2 and all(name in names for name in wanted[:2]):
            return tuple(places)
    return ()


def most_moved(columns: Mapping[str, np.ndarray], lengths: np.ndarray, names: Names) -> str:
    """The object that is handled: whose position changes most within episodes.

    Args:
        columns: Feature name to raw (F, d), episodes one after the other.
        lengths: (N,) frames per episode.
        names: Of the features' dimensions.

    Raises:
        ValueError: If there is no hand, or nothing else.
    """
    poses = find_poses({key: names[key] for key in columns if key in names and key != ACTION})
    hand = hand_of(poses)
    objects = {name: pose for name, pose in poses.items() if name != hand}
    # What lies in one feature with the hand and does not turn is another point of the robot.
    objects = {k: p for k, p in objects.items() if p.turns or p.key != poses[hand].key} or objects
    if not objects:
        raise ValueError(
            "backbone.encoder='objects': no object is among the observations; dimensions of its position are "
            "called box.x, box.y, ...; name them with policy.dimension_names={feature: [names]}"
        )
    starts = np.cumsum(lengths) - lengths
    moved = {}
    for name, pose in objects.items():
        path = pose.position(torch.from_numpy(columns[pose.key])).numpy()
        away = path - np.repeat(path[starts], lengths, axis=0)
        moved[name] = (pose.turns, float(np.square(away).sum(axis=1).mean()))
    largest = max(value for _, value in moved.values())
    # Of those that move as much, one that has an orientation.
    return max(moved, key=lambda name: (moved[name][1] > 0.1 * largest, moved[name]))


def linear_map(normalize: Normalize, key: str, d: int) -> tuple[Tensor, Tensor]:
    """What zeros and ones of a feature of d dimensions are normalised to, (d,) each."""
    low, high = normalize({key: torch.stack([torch.zeros(d), torch.ones(d)])})[key].cpu()
    return low, high
