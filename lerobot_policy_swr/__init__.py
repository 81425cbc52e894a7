"""Entry point that LeRobot's plugin discovery imports; importing it registers everything of `lerobot_swr`.

LeRobot imports every installed distribution whose name starts with ``lerobot_policy_`` as a module, so
this shim carries the distribution's name and hands over to the real package.
"""

import lerobot_swr

__version__ = lerobot_swr.__version__
