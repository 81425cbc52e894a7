"""The inverse model: which change of the action undoes a deviation of the state, from demonstrations alone.

Fitted by ridge regression, for a horizon of h steps:

    a_t = M s_t + K (s_{t+h} − s_t) + c

Beside the path, at x instead of s_u, the action that still leads to s_{u+h} differs by J (x − s_u), with
J = M − K.
"""

import logging
from dataclasses import dataclass

import numpy as np
from lerobot.utils.constants import ACTION, OBS_STATE

from lerobot_swr.corrective.relative_actions import target_dimensions
from lerobot_swr.trajectories import Trajectories

RIDGE = 1e-3  # in units of the standardised regressors' variance
MIN_R2 = 0.8  # action dimensions that are explained less get no correction
FOLDS = 5
MAX_HORIZON = 30  # steps, and at most a quarter of an episode
DISPLACEMENT_HORIZON = 3  # steps in which displacements lead back to the path, where the data allow it
MAX_FRAMES = 100_000  # of evenly chosen episodes; the fit has few unknowns

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class InverseModel:
    """How actions answer to deviations, in raw units.

    Attributes:
        horizon: h, in steps.
        gain: (A, d) J; rows of zeros where `r2` is below `MIN_R2`.
        r2: (A,) coefficient of determination on held-out episodes.
        targets: (A,) state dimension whose target an action dimension is, -1 for none.
    """

    horizon: int
    gain: np.ndarray
    r2: np.ndarray
    targets: np.ndarray

    @property
    def corrected(self) -> np.ndarray:
        """(A,) bool, the dimensions that are corrected."""
        return self.r2 >= MIN_R2


def fit_inverse_model(
    trajectories: Trajectories, horizon: int | None = None, absolute: bool | None = None
) -> InverseModel:
    """Fit the inverse model of a dataset.

    An action dimension that is a target of a state dimension is explained by that dimension alone: joints
    move together in demonstrations, and a regression on all of them cannot tell whose target is whose.

    Args:
        trajectories: Episodes with ``observation.state`` and ``action``.
        horizon: h; None takes it from the data. For targets it is the servo's lag: the first h at which J
            crosses 0, so that a target is repeated as it was and the servo leads back. For displacements it
            is the h nearest to `DISPLACEMENT_HORIZON` that explains most dimensions.
        absolute: Whether actions are targets; None asks the data.

    Raises:
        ValueError: With fewer than 2 episodes, with fewer than 2 that are longer than the horizon, or if no
            dimension of the action is explained.
    """
    name = trajectories.name
    if len(trajectories) < 2:
        raise ValueError(
            f"dataset {name} has a single episode; corrective labels fit an inverse model and test it on "
            "held-out episodes, so they need at least 2: record more, or use --policy.corrective=none"
        )
    longest = max(1, min(MAX_HORIZON, int(trajectories.lengths.mean()) // 4))
    if horizon is not None and not 1 <= horizon <= longest:
        raise ValueError(f"corrective_horizon={horizon}: expected 1 to {longest} steps, or null")
    data = _Frames(trajectories)
    targets = target_dimensions(data.states, data.actions, absolute)
    horizons = [h for h in (range(1, longest + 1) if horizon is None else [horizon]) if data.can_hold_out(h)]
    if not horizons:
        fix = "--policy.corrective=none" if horizon is None else "a smaller --policy.corrective_horizon"
        raise ValueError(
            f"dataset {name}: fewer than 2 of its {len(trajectories)} episodes are longer than the horizon "
            f"of {horizon or 1}, and the inverse model is tested on held-out ones; record longer ones, or "
            f"use {fix}"
        )
    model = _choose([_fit(data, targets, h) for h in horizons])
    if not model.corrected.any():
        raise ValueError(
            f"dataset {name}: no dimension of the action follows from the states before and after it "
            f"(held-out R² at most {model.r2.max():.2f}, needed {MIN_R2}), so nothing tells which action "
            "corrects a deviation; use --policy.corrective=none"
        )
    return model


def _choose(models: list[InverseModel]) -> InverseModel:
    """The model with the best horizon."""
    is_target = models[0].targets >= 0
    if not is_target.any():
        return max(models, key=lambda m: (m.corrected.sum(), -abs(m.horizon - DISPLACEMENT_HORIZON)))
    own = np.flatnonzero(is_target)
    mean_gain = [model.gain[own, model.targets[own]].sum() for model in models]
    behind = [place for place, gain in enumerate(mean_gain) if gain >= 0 and models[place].corrected.any()]
    return models[behind[0] if behind else int(np.abs(mean_gain).argmin())]


class _Frames:
    """Frames of a dataset (of evenly chosen episodes of a large one), in float64.

    Attributes:
        states: (F, d).
        actions: (F, A).
        fold: (F,) which fold holds the frame's episode out.
        left: (F,) frames that follow in the episode.
    """

    def __init__(self, trajectories: Trajectories):
        stride = -(-int(trajectories.lengths.sum()) // MAX_FRAMES)
        if stride > 1:
            count = max(2, len(trajectories) // stride)
            trajectories = trajectories.subset(
                np.linspace(0, len(trajectories) - 1, count).round().astype(int).tolist()
            )
        lengths = trajectories.lengths
        self.states = trajectories.columns[OBS_STATE].astype(np.float64)
        self.actions = trajectories.columns[ACTION].astype(np.float64)
        self.fold = np.repeat(np.arange(len(lengths)) % min(FOLDS, len(lengths)), lengths)
        last = np.repeat(trajectories.starts + lengths - 1, lengths)
        self.left = last - np.arange(len(last))

    def can_hold_out(self, horizon: int) -> bool:
        """Whether frames are left to fit when one fold is held out."""
        return len(np.unique(self.fold[self.left >= horizon])) >= 2


def _fit(data: _Frames, targets: np.ndarray, horizon: int) -> InverseModel:
    rows = np.flatnonzero(data.left >= horizon)
    now, change = data.states[rows], data.states[rows + horizon] - data.states[rows]
    actions, fold = data.actions[rows], data.fold[rows]
    dim = now.shape[1]
    gain, r2 = np.zeros((actions.shape[1], dim)), np.zeros(actions.shape[1])
    others = np.flatnonzero(targets < 0)
    groups = [([k], [targets[k]]) for k in np.flatnonzero(targets >= 0)]
    groups += [(others.tolist(), list(range(dim)))] if len(others) else []
    for explained, regressors in groups:
        both = np.concatenate([now[:, regressors], change[:, regressors]], axis=1)
        coefficients, r2[explained] = _ridge(both, actions[:, explained], fold)
        m, k = np.split(coefficients, 2)
        gain[np.ix_(explained, regressors)] = (m - k).T
    gain[r2 < MIN_R2] = 0.0
    return InverseModel(horizon, gain, r2, targets)


def _ridge(regressors: np.ndarray, explained: np.ndarray, fold: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ridge regression with an intercept, and its cross-validated R².

    Args:
        regressors: (F, p); constant ones get the coefficient 0.
        explained: (F, q).
        fold: (F,) which fold holds a frame out.

    Returns:
        (p, q) coefficients of all frames together and (q,) R² over the held-out frames, 0 for a constant.
    """
    x_scale, y_scale = (np.where(v.std(axis=0) > 0, v.std(axis=0), 1.0) for v in (regressors, explained))
    # Near zero mean, so that sums of products lose no digits.
    x = (regressors - regressors.mean(axis=0)) / x_scale
    y = (explained - explained.mean(axis=0)) / y_scale
    both = np.concatenate([np.ones((len(x), 1)), x, y], axis=1)
    folds = np.unique(fold)
    moments = np.stack([both[fold == f].T @ both[fold == f] for f in folds])  # (folds, 1 + p + q, 1 + p + q)
    total = moments.sum(axis=0)

    p = x.shape[1]
    squared, variation = np.zeros(y.shape[1]), np.zeros(y.shape[1])
    for held_out in moments:
        coefficients, mean = _solve(total - held_out, p)
        about_mean = _moments_about(held_out, mean)
        xx, xy, yy = about_mean[:p, :p], about_mean[:p, p:], np.diag(about_mean)[p:]
        squared += yy - 2 * (coefficients * xy).sum(axis=0) + (coefficients * (xx @ coefficients)).sum(axis=0)
        variation += yy
    r2 = 1 - np.divide(squared, variation, out=np.ones_like(squared), where=variation > 0)
    return _solve(total, p)[0] * y_scale / x_scale[:, None], r2


def _solve(moments: np.ndarray, p: int) -> tuple[np.ndarray, np.ndarray]:
    """(p, q) coefficients and (p + q,) means, from the sums of products of (1, x, y)."""
    count, mean = moments[0, 0], moments[0, 1:] / moments[0, 0]
    covariance = _moments_about(moments, mean) / count
    return np.linalg.solve(covariance[:p, :p] + RIDGE * np.eye(p), covariance[:p, p:]), mean


def _moments_about(moments: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """(p + q, p + q) sums of products of deviations from a mean."""
    sums = moments[0, 1:]
    return (
        moments[1:, 1:] - np.outer(sums, mean) - np.outer(mean, sums) + moments[0, 0] * np.outer(mean, mean)
    )


def log_inverse_model(model: InverseModel, names: list[str] | None) -> None:
    """Say per action dimension how well it is explained and what becomes of it.

    Args:
        model: The model.
        names: A names of the action's dimensions, if known.
    """
    labels = names if names is not None and len(names) == len(model.r2) else map(str, range(len(model.r2)))
    parts = [
        f"{label} {r2:.2f}{' (target)' if target >= 0 else ''}{'' if corrected else ' (not corrected)'}"
        for label, r2, target, corrected in zip(labels, model.r2, model.targets, model.corrected, strict=True)
    ]
    logger.info(
        "Corrective labels: horizon %d steps; held-out R² of the action: %s", model.horizon, ", ".join(parts)
    )
