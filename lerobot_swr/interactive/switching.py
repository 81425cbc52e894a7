"""Does a style that is requested in mid-rollout still show its behaviour, and how soon does it act?

A rollout of one behaviour's style is switched to another's at chosen moments: just after what it shows has
changed (in a maze: after each wall) and a few steps before that. Judged is what is shown from the switch on,
against what the requested behaviour can still show from there (`Task.expected_behavior`).
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_swr.interactive.session import Session

BEFORE = 4  # steps before a change, when there is hardly time left
MAX_LATENCY = 64  # steps; a style that has not acted by then counts as this


@dataclass(frozen=True)
class Switch:
    """One rollout that was switched.

    Attributes:
        first: Behaviour of the style that it began with.
        requested: Behaviour of the style that was requested.
        moment: When, for example ``after 1`` or ``before 2`` changes of what is shown.
        step: Actions taken before the request.
        expected: What the requested behaviour can still show from there.
        shown: What was shown from there.
        success: Whether the rollout succeeded.
        latency: Actions from the request to the first that differs from those of the rollout without it.
    """

    first: str
    requested: str
    moment: str
    step: int
    expected: str
    shown: str
    success: bool
    latency: int


def measure_switches(
    session: Session, demonstrated: Sequence[str], n_first: int = 3, seed: int = 0
) -> list[Switch]:
    """Switch rollouts of a session's policy from behaviour to behaviour.

    Args:
        session: With a style policy and a behaviour rule.
        demonstrated: Label of each of the policy's training episodes.
        n_first: Begin so many rollouts, each with another behaviour, for every behaviour requested.
        seed: Of the styles and the environment.
    """
    assert session.checkpoint is not None
    rng = np.random.default_rng(seed)
    allowed = [i for i in session.checkpoint.policy.styles.allowed().tolist() if i < len(demonstrated)]
    behaviors = sorted({demonstrated[i] for i in allowed})

    def style_of(behavior: str) -> int:
        return int(rng.choice([i for i in allowed if demonstrated[i] == behavior]))

    switches = []
    for requested in behaviors:
        others = [behavior for behavior in behaviors if behavior != requested]
        for first in rng.permutation(others)[:n_first].tolist():
            style, other = style_of(first), style_of(requested)
            actions, moments = _unswitched(session, style, seed)
            switches += [
                _switched(session, (style, other), (first, requested), moment, step, actions, seed)
                for moment, step in moments.items()
            ]
    return switches


def share_kept(switches: Sequence[Switch]) -> dict[str, dict[str, tuple[int, int]]]:
    """Requested behaviour to moment to how many switches showed it, of how many."""
    found: dict[str, dict[str, list[bool]]] = defaultdict(lambda: defaultdict(list))
    for switch in switches:
        found[switch.requested][switch.moment].append(switch.success and switch.shown == switch.expected)
    return {
        requested: {moment: (sum(kept), len(kept)) for moment, kept in moments.items()}
        for requested, moments in found.items()
    }


def _unswitched(session: Session, style: int, seed: int) -> tuple[np.ndarray, dict[str, int]]:
    """The actions of a rollout with one style, and the moments at which it is worth switching."""
    session.reset(seed=seed, styles=style)
    labels = [session.behavior()]
    while not session.scene.over:
        session.step()
        labels.append(session.behavior())
    changes = [t for t in range(1, len(labels)) if labels[t] != labels[t - 1]][:-1]  # the last is the end
    moments = {"after 0": 0}
    for number, change in enumerate(changes, start=1):
        if change > BEFORE:
            moments[f"before {number}"] = change - BEFORE
        moments[f"after {number}"] = change
    return session.recording().actions[:-1], moments


def _switched(
    session: Session,
    styles: tuple[int, int],
    behaviors: tuple[str, str],
    moment: str,
    step: int,
    unswitched: np.ndarray,
    seed: int,
) -> Switch:
    session.reset(seed=seed, styles=styles[0])
    for _ in range(step):
        session.step()
    session.steer(styles[1])
    while not session.scene.over:
        session.step()
    states = {key: values[step:] for key, values in session.states().items()}
    assert session.rule is not None
    actions = session.recording().actions[:-1]
    both = min(len(actions), len(unswitched))
    differs = (actions[step:both] != unswitched[step:both]).any(axis=1)
    return Switch(
        *behaviors,
        moment,
        step,
        session.task.expected_behavior(behaviors[1], states),
        session.rule(states),
        session.scene.success,
        latency=int(differs.argmax()) + 1 if differs.any() else MAX_LATENCY,
    )
