"""``python -m lerobot_swr``: versions, the plugins that LeRobot finds, what is registered, what is missing.

Paste what it prints into a bug report.
"""

import platform
import sys
from importlib.metadata import PackageNotFoundError, version

from lerobot.configs import PreTrainedConfig
from lerobot.envs import EnvConfig
from lerobot.utils.import_utils import register_third_party_plugins

import lerobot_swr
from lerobot_swr.ffmpeg import missing_ffmpeg
from lerobot_swr.installation import DISTRIBUTION, extras, plugins, unmet_requirements
from lerobot_swr.policies.backbones.registry import BackboneConfig


def describe() -> str:
    """The installation, in lines."""
    lines = [
        f"lerobot_swr {lerobot_swr.__version__}, Python {platform.python_version()}, {platform.platform()}",
        ", ".join(f"{name} {version(name)}" for name in ("lerobot", "torch", "numpy")),
        "plugins: " + ", ".join(f"{name} {number}" for name, number in plugins().items()),
        "policies: " + ", ".join(_names_of(PreTrainedConfig, "lerobot_swr.")),
        "backbones: " + ", ".join(_names_of(BackboneConfig)),
        "environments: " + ", ".join(_names_of(EnvConfig, "lerobot_swr.")),
    ]
    unmet = unmet_requirements()
    lines += [f"missing: {', '.join(unmet)}; run pip install '{DISTRIBUTION}'"] if unmet else []
    for extra in extras():
        unmet = unmet_requirements(extra=extra)
        way = f"without {', '.join(unmet)}; pip install '{DISTRIBUTION}[{extra}]'" if unmet else "installed"
        lines.append(f"extra {extra}: {way}")
    lines.append(f"video: {missing_ffmpeg() or 'torchcodec'}")
    return "\n".join(lines)


def _names_of(registry: type, module: str = "") -> list[str]:
    choices = registry.get_known_choices()  # type: ignore[attr-defined]
    return sorted(name for name, choice in choices.items() if choice.__module__.startswith(module))


def main() -> None:
    """Entry point."""
    register_third_party_plugins()
    try:
        print(describe())
    except PackageNotFoundError as error:
        print(
            f"error: the distribution {error.name!r} is not installed, so LeRobot does not find it: "
            f"pip install {DISTRIBUTION}, or pip install -e . in a checkout",
            file=sys.stderr,
        )
        sys.exit(1)


if __name__ == "__main__":
    main()
