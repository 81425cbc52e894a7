"""The table of the suite scenes: own scenes, new ones, and blind replay."""

from lerobot_swr.evaluation.report import Table
from lerobot_swr.reproduction.cell_texts import NOTHING, rollouts, share, steps
from lerobot_swr.reproduction.stored_results import StoredCell, SuiteResults
from lerobot_swr.reproduction.suites import SCENE_CONDITIONS
from lerobot_swr.reproduction.summary import Rate, rate


def scenes(suite: SuiteResults, dataset: str) -> Table:
    """Success and fidelity of every policy in the demonstrations' own scenes and in new ones."""
    cells = {(c.labels.policy, c.labels.condition): c for c in suite.evaluations(dataset)}
    own, new = SCENE_CONDITIONS["own"], SCENE_CONDITIONS["new"]
    rows = []
    for policy in dict.fromkeys(policy for policy, _ in cells):
        in_own, in_new = cells.get((policy, own)), cells.get((policy, new))
        for protocol in in_new.protocols if in_new is not None else ["-"]:
            present = in_new or in_own
            assert present is not None
            rows.append(
                (
                    policy,
                    protocol,
                    steps(present),
                    rollouts(present.best),
                    *_pair(in_own, None),
                    *_pair(in_new, protocol),
                    *(_replayed(in_new, protocol, column) for column in ("success", "match")),
                )
            )
    caption = (
        f"{dataset}: each rollout in the recorded scene of the demonstration whose style it uses (own), and "
        "in scenes that nobody demonstrated (new; rollout k of a training seed meets the same scene whatever "
        "the policy). Fidelity: share of rollouts that show the behaviour of their style's demonstration; of "
        "policies without styles that of one drawn at random, so what chance gives. Blind: the actions of "
        "these demonstrations, played open loop in the same new scenes. Over all rollouts [Wilson 95 %], "
        "lowest to highest seed in parentheses."
    )
    header = (
        "policy",
        "styles drawn",
        "steps × batch",
        "seeds × n",
        "own:\nsuccess",
        "own:\nfidelity",
        "new:\nsuccess",
        "new:\nfidelity",
        "blind:\nsuccess",
        "blind:\nfidelity",
    )
    return Table(caption, header, rows)


def _pair(cell: StoredCell | None, protocol: str | None) -> tuple[str, str]:
    """Success and fidelity of one way of drawing styles, None: the cell's best."""
    if cell is None:
        return NOTHING, NOTHING
    summary = cell.best if protocol is None else cell.summaries[protocol]
    return share(summary.success), share(summary.fidelity)


def _replayed(cell: StoredCell | None, protocol: str, column: str) -> str:
    if cell is None:
        return NOTHING
    return share(_replay_rate(cell, protocol, column))


def _replay_rate(cell: StoredCell, protocol: str, column: str) -> Rate:
    parts = [by_protocol[protocol] for by_protocol in cell.result["rollouts"].values()]
    return rate([part[f"replay_{column}"] for part in parts])
