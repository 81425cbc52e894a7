"""What the source of a policy says before the policy, of perhaps billions of weights, is made."""

import importlib.util
from pathlib import Path

from lerobot.configs import PreTrainedConfig

# How LeRobot's policies call the observations of numbers.
NUMBERS = ("OBS_STATE", "observation.state", "robot_state", "OBS_ENV_STATE", "observation.environment_state")
INPUTS = (*NUMBERS, "env_state")


def turns_state_into_text(config: PreTrainedConfig) -> bool:
    """Whether a policy's processor reads the state while the module of its network names no such observation.

    LeRobot's policies lie in modules called ``modeling_…`` and ``processor_…`` beside ``configuration_…``.
    A policy whose modules are elsewhere, a plugin's (whose network may lie in any file), or not readable, is
    not judged.
    """
    if not type(config).__module__.startswith("lerobot."):
        return False
    network, processor = (_source(type(config).__module__, kind) for kind in ("modeling_", "processor_"))
    if network is None or processor is None:
        return False
    return not any(name in network for name in INPUTS) and any(name in processor for name in NUMBERS)


def _source(module: str, kind: str) -> str | None:
    """Text of the module beside that of a configuration."""
    name = module.replace("configuration_", kind)
    if name == module:
        return None
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None or not Path(spec.origin).is_file():
        return None
    return Path(spec.origin).read_text(encoding="utf-8", errors="replace")
