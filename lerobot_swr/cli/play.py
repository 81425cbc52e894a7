"""``lerobot-swr-play``: record demonstrations, see the styles and steer, in one page of the browser.

Examples:
    lerobot-swr-play --env.type=maze2d --env.task=medium --dataset.root=data/mine       # record, train, steer
    lerobot-swr-play --env.type=maze2d --env.task=medium --policy.path=CHECKPOINT       # steer
"""

import os
import sys
import webbrowser
from dataclasses import dataclass, field

from lerobot.configs import PreTrainedConfig, parser
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot.utils.utils import init_logging

from lerobot_swr.behavior_rules import load_behavior_rule
from lerobot_swr.cli.errors import explain_errors
from lerobot_swr.cli.eval_options import checkpoint_config
from lerobot_swr.cli.literal_flags import with_literal_text
from lerobot_swr.errors import MissingExtraError
from lerobot_swr.evaluation.checkpoint import DatasetSource
from lerobot_swr.interactive.hub import Hub
from lerobot_swr.interactive.worker import PlayJob, check_job, work

TEXT_FLAGS = ("behavior_rule", "policy.style_filter")
LOOPBACK = ("127.0.0.1", "::1", "localhost")


@dataclass
class PlayCommand:
    """Options of ``lerobot-swr-play``."""

    # The environment to play in.
    env: EnvConfig | None = None
    # A folder to record into, new or begun. With a policy: its training dataset, for paths in the map.
    dataset: DatasetSource = field(default_factory=DatasetSource)
    # To steer: give --policy.path=FOLDER; other --policy.* flags override the checkpoint's configuration.
    policy: PreTrainedConfig | None = None
    # Labels episodes: module:function; null takes the environment's own rule.
    behavior_rule: str | None = None
    # Of the environment; null differs every time.
    seed: int | None = None
    # Address to listen on. Everybody who reaches it can record, train and steer.
    host: str = "127.0.0.1"
    # Port to listen on; 0 takes any that is free.
    port: int = 8420
    # Whether to open the page in this machine's browser.
    open: bool = True

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: Naming the offending key and value.
        """
        if self.env is None:
            raise ValueError("env.type is missing: give the environment, e.g. --env.type=maze2d")
        if not 0 <= self.port <= 65535:
            raise ValueError(f"port={self.port}: expected 0 to 65535")
        if self.behavior_rule is not None:
            load_behavior_rule(self.behavior_rule)
        path = parser.get_path_arg("policy")
        if path:
            self.policy = checkpoint_config(path)
        elif self.dataset.root is None:
            raise ValueError(
                "give --dataset.root=FOLDER to record into, or --policy.path=CHECKPOINT to steer a policy"
            )

    @classmethod
    def __get_path_fields__(cls) -> list[str]:
        """Keys that LeRobot's parser loads from a folder."""
        return ["policy"]


@parser.wrap()
def play(cfg: PlayCommand) -> None:
    """Serve the page until Ctrl-C."""
    assert cfg.env is not None
    job = PlayJob(cfg.env, cfg.policy, cfg.dataset, cfg.behavior_rule, cfg.seed)
    check_job(job)
    try:
        from lerobot_swr.interactive.server import bind, serve
    except ModuleNotFoundError as error:
        raise MissingExtraError("the page", "play", error) from error
    listener = bind(cfg.host, cfg.port)
    port = listener.getsockname()[1]
    name = f"[{cfg.host}]" if ":" in cfg.host else cfg.host
    url = f"http://{'127.0.0.1' if cfg.host == '0.0.0.0' else name}:{port}"
    if cfg.host not in LOOPBACK:
        print(f"host={cfg.host!r}: everybody who reaches this address can record, train and steer")
    print(f"open {url} in a browser; Ctrl-C ends", flush=True)
    if cfg.open and (
        sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        webbrowser.open(url)
    serve(Hub(work, job, cfg.dataset.repo_id, cfg.behavior_rule), cfg.host, listener)


@explain_errors
def main() -> None:
    """Entry point."""
    init_logging()
    register_third_party_plugins()
    sys.argv = list(with_literal_text(sys.argv, TEXT_FLAGS))
    play()


if __name__ == "__main__":
    main()
