"""Switches of style in mid-rollout: requested behaviour × moment, share that still shows it; latency.

python -m benchmarks.bench_style_switch --policy.path=CHECKPOINT --env.type=maze2d --env.task=medium \
        --dataset.root=TRAINING_DATASET [--n_first=3]
"""

import json
from collections import Counter
from dataclasses import asdict, dataclass, field
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_swr.cli.eval_options import checkpoint_config
from lerobot_swr.evaluation.checkpoint import DatasetSource, load_checkpoint, load_reference
from lerobot_swr.evaluation.metrics import success_interval
from lerobot_swr.interactive.session import Session
from lerobot_swr.interactive.switching import measure_switches, share_kept


@dataclass
class SwitchCommand:
    """Options."""

    env: EnvConfig | None = None
    policy: PreTrainedConfig | None = None
    # The policy's training dataset.
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # Rollouts of as many other behaviours are switched to each behaviour.
    n_first: int = 3
    # Of the styles and the environment.
    seed: int = 0
    # Where style_switch.json goes.
    output_dir: Path = Path("outputs/style_switch")

    def __post_init__(self) -> None:
        """Find the checkpoint."""
        path = parser.get_path_arg("policy")
        if self.env is None or not path:
            raise ValueError("give --env.type=... and --policy.path=CHECKPOINT")
        self.policy = checkpoint_config(path)

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Keys that LeRobot's parser loads from a folder."""
        return ["policy"]


@parser.wrap()
def measure(cfg: SwitchCommand) -> None:
    assert cfg.env is not None
    assert cfg.policy is not None
    checkpoint = load_checkpoint(cfg.policy)
    session = Session(cfg.env, checkpoint, cfg.seed)
    assert session.rule is not None
    trajectories = load_reference(cfg.dataset, checkpoint)
    demonstrated = [session.rule(episode) for episode in trajectories.episodes()]
    switches = measure_switches(session, demonstrated, cfg.n_first, cfg.seed)
    kept = share_kept(switches)
    moments = sorted({switch.moment for switch in switches}, key=_order)
    print(" | ".join(["requested", *moments]))
    for requested, by_moment in kept.items():
        cells = [by_moment.get(moment) for moment in moments]
        print(" | ".join([requested, *("–" if cell is None else f"{cell[0]}/{cell[1]}" for cell in cells)]))
    for moment in moments:
        cells = [by_moment[moment] for by_moment in kept.values() if moment in by_moment]
        good, total = (sum(cell[k] for cell in cells) for k in (0, 1))
        interval = success_interval([True] * good + [False] * (total - good))
        print(f"{moment}: {good}/{total} = {good / total:.3f} {interval:.3f}")
    print(f"steps to the first action of the new style: {dict(Counter(s.latency for s in switches))}")
    cfg.output_dir.mkdir(parents=True, exist_ok=True)
    path = cfg.output_dir / "style_switch.json"
    path.write_text(json.dumps([asdict(switch) for switch in switches], indent=1))
    print(f"written to {path}")


def _order(moment: str) -> tuple[int, bool]:
    name, number = moment.split()
    return int(number), name == "after"


if __name__ == "__main__":
    register_third_party_plugins()
    measure()
