"""What is installed: this package's extras, LeRobot's plugins, and what is missing of them."""

import contextlib
import platform
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution, distributions, version

from packaging.requirements import Requirement

from lerobot_swr.version import __version__

DISTRIBUTION = "lerobot_policy_swr"
# Source: lerobot.utils.import_utils.register_third_party_plugins
PLUGIN_PREFIXES = (
    "lerobot_robot_",
    "lerobot_camera_",
    "lerobot_teleoperator_",
    "lerobot_policy_",
    "lerobot_env_",
)
PACKAGES = ("lerobot", "torch", "numpy", "mujoco", "diffusers")  # noted where installed
FOR_DEVELOPERS = ("dev", "docs", "test")


class MissingExtraError(ModuleNotFoundError):
    """An optional package that is needed now is not installed; the message says how to install it."""

    def __init__(self, what: str, extra: str, error: ModuleNotFoundError):
        super().__init__(
            f"{what} needs the package {error.name!r}: run pip install '{DISTRIBUTION}[{extra}]'",
            name=error.name,
        )


def unmet_requirements(name: str = DISTRIBUTION, extra: str = "") -> list[str]:
    """What a distribution asks for, with one of its extras, and is not installed as it asks.

    Args:
        name: The distribution.
        extra: One of its extras; by default what it always needs.

    Returns:
        Requirements, as ``package>=version``, with what is installed instead.

    Raises:
        PackageNotFoundError: If the distribution is not installed.
    """
    return list(dict.fromkeys(_unmet(name, extra)))


def _unmet(name: str, extra: str) -> Iterator[str]:
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        marker = requirement.marker
        asked = marker is None or marker.evaluate({"extra": extra})
        if not asked or (extra and (marker is None or marker.evaluate({"extra": ""}))):
            continue  # of an extra only what it adds
        asks = f"{requirement.name}{requirement.specifier}"
        try:
            installed = distribution(requirement.name).version
        except PackageNotFoundError:
            yield asks
            continue
        # With prereleases: this package's own development versions are versions, too.
        if not requirement.specifier.contains(installed, prereleases=True):
            yield f"{asks} (installed: {installed})"
        for more in sorted(requirement.extras):
            yield from _unmet(requirement.name, more)


def extras() -> list[str]:
    """This distribution's extras for users."""
    listed = distribution(DISTRIBUTION).metadata.get_all("Provides-Extra") or []
    return sorted(set(listed) - set(FOR_DEVELOPERS))


def plugins() -> dict[str, str]:
    """Names of the installed distributions that LeRobot takes for plugins, to their versions."""
    found = {str(one.metadata["Name"]): one.version for one in distributions() if one.metadata["Name"]}
    return {name: found[name] for name in sorted(found) if name.startswith(PLUGIN_PREFIXES)}


def installed_versions() -> dict[str, str]:
    """Of Python, of this package and of those of `PACKAGES` that are installed."""
    # An editable installation's metadata are those of the day when it was made.
    versions = {"python": platform.python_version(), DISTRIBUTION: __version__}
    for name in PACKAGES:
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions
